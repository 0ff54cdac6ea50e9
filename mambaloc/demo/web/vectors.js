/** Vectors of three numbers, and matrices as rows of numbers. */

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const minus = (a, b, factor = 1) => [a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]];
export const scaled = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
export const unit = (a) => scaled(a, 1 / (Math.hypot(a[0], a[1], a[2]) || 1));

/**
 * Solve square equations by Gauss's elimination with pivots.
 * @param {number[][]} matrix rows.
 * @param {number[][]} right a row each, of as many columns as there are right sides.
 * @returns {number[][]|null} the solutions as columns; null where the matrix is singular.
 */
export function solved(matrix, right) {
  const rows = matrix.map((row, i) => [...row, ...right[i]]);
  const size = rows.length;
  for (let column = 0; column < size; column++) {
    let pivot = column;
    for (let row = column + 1; row < size; row++) {
      if (Math.abs(rows[row][column]) > Math.abs(rows[pivot][column])) pivot = row;
    }
    [rows[column], rows[pivot]] = [rows[pivot], rows[column]];
    const head = rows[column];
    if (!(Math.abs(head[column]) > 0)) return null;
    for (let row = 0; row < size; row++) {
      if (row === column) continue;
      const factor = rows[row][column] / head[column];
      for (let i = column; i < head.length; i++) rows[row][i] -= factor * head[i];
    }
  }
  return rows.map((row, i) => row.slice(size).map((value) => value / row[i]));
}

/** Null where there is none. */
export function inverse(matrix) {
  return solved(matrix, matrix.map((row, i) => row.map((_, j) => Number(i === j))));
}

export function product(a, b) {
  const columns = transposed(b);
  return a.map((row) => columns.map((column) => row.reduce((sum, value, i) => sum + value * column[i], 0)));
}

export function transposed(matrix) {
  return matrix[0].map((_, column) => matrix.map((row) => row[column]));
}

/** The largest eigenvalue of a symmetric matrix of 3x3, from the roots of its characteristic polynomial. */
export function largestEigenvalue([[a, b, c], [, d, e], [, , f]]) {
  const mean = (a + d + f) / 3;
  const spread = Math.sqrt(((a - mean) ** 2 + (d - mean) ** 2 + (f - mean) ** 2 + 2 * (b * b + c * c + e * e)) / 6);
  if (!(spread > 0)) return mean;
  const rows = [[a - mean, b, c], [b, d - mean, e], [c, e, f - mean]].map((row) => scaled(row, 1 / spread));
  const half = Math.min(1, Math.max(-1, dot(rows[0], cross(rows[1], rows[2])) / 2));
  return mean + 2 * spread * Math.cos(Math.acos(half) / 3);
}
