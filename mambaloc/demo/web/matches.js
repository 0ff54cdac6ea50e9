/** The map's points where the image shows them. */

const RADIUS = 2.75; // CSS pixels, less in a small image

/**
 * Draw matches over the image: those that agree with the pose as dots, coloured by how far they are off, by its root
 * since most are off by little; the others as rings.
 * @param {HTMLCanvasElement} canvas that lies on the image.
 * @param {{x: number, y: number, off: number}[]} matches in shares of the image; inliers are off by 1 at most.
 */
export function drawMatches(canvas, matches) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const ratio = Math.min(devicePixelRatio, 2);
  Object.assign(canvas, { width: width * ratio, height: height * ratio }); // which clears it
  const context = canvas.getContext("2d");
  const style = getComputedStyle(canvas);
  const [near, far, wrong] = ["--near", "--far", "--off"].map((name) => style.getPropertyValue(name).trim());
  context.scale(ratio, ratio);
  const radius = Math.min(RADIUS, width / 100);
  for (const { x, y, off } of [...matches].sort((a, b) => b.off - a.off)) {
    const agrees = off <= 1;
    context.beginPath();
    context.arc(x * width, y * height, agrees ? radius : 0.8 * radius, 0, 2 * Math.PI);
    context.fillStyle = `color-mix(in oklab, ${near}, ${far} ${(100 * Math.sqrt(Math.min(off, 1))).toFixed(0)}%)`;
    context.strokeStyle = agrees ? "rgb(0 0 0 / 60%)" : wrong;
    context.lineWidth = 0.36 * radius;
    if (agrees) context.fill();
    context.stroke();
  }
}
