"""A trajectory to turn around: one HTML page that holds all it needs, and loads nothing."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.files import atomic_file
from mambaloc.geometry import matrix_from_quaternion
from mambaloc.metrics import PoseErrorTable
from mambaloc.viz.trajectory import TRUE_COLOR, box_around, means, medians

_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "showSendToCloud": False,  # plotly 7 shows a button that uploads the chart unless this is set
    "plotlyServerURL": "",
}
_REDS = ((0.0, "#fb9272"), (0.5, "#d7301f"), (1.0, "#67000d"))


def write_scene_page(
    table: PoseErrorTable, sequences: Sequence[str], names: Sequence[str], path: Path, title: str
) -> None:
    """Write a split's true path (green) and predicted positions (red, darker where the rotation is more wrong).

    Pointing at a position shows its frame and errors.

    Args:
        table: errors of the split, one row a frame.
        sequences: each frame's sequence; the path breaks from one to the next.
        names: what each frame is called.
        path: the HTML file to write.
        title: heads the page, before medians and means.

    Raises:
        InputError: without the extra ``viz``.
    """
    try:
        from plotly.graph_objects import Figure
    except ImportError:
        raise InputError(f"{path.name}: needs plotly. Run pip install 'mambaloc[viz]'.") from None
    index = table.index.tolist()
    ours, theirs = [names[i] for i in index], [sequences[i] for i in index]
    labels = _labels(ours, table.position_error_m.tolist(), table.rotation_error_deg.tolist())
    figure = Figure(data=[_offsets(table, labels), _true_path(table, theirs, ours), _predictions(table, labels)])
    figure.update_layout(
        template="plotly_white",
        scene=_view(table),
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={"x": 0.01, "y": 0.99, "itemsizing": "constant"},
        hoverlabel={"bgcolor": "white"},
        font={"family": "system-ui, sans-serif", "size": 13},
    )
    plot = figure.to_html(full_html=False, include_plotlyjs=True, config=_CONFIG)
    summary = f"{medians(table)}; {means(table)}; {len(index)} frames"
    heading, *details = title.split("\n")
    page = _PAGE.substitute(title=html.escape(heading), summary=html.escape("; ".join((*details, summary))), plot=plot)
    with atomic_file(path) as partial:
        partial.write_text(page, encoding="utf-8")


def _true_path(table: PoseErrorTable, sequences: Sequence[str], names: Sequence[str]) -> Any:
    """The green line; an empty point between sequences breaks it."""
    from plotly.graph_objects import Scatter3d

    true_m = table.true_position_m.cpu().numpy()
    starts = [row for row in range(1, len(sequences)) if sequences[row] != sequences[row - 1]]
    broken_m = np.insert(true_m, starts, np.nan, axis=0)
    texts = np.insert(np.array(names, dtype=object), starts, "").tolist()
    return Scatter3d(
        **_coordinates(broken_m),
        mode="lines",
        name="ground truth",
        line={"color": TRUE_COLOR, "width": 5},
        text=texts,
        hovertemplate="%{text}<br>ground truth<extra></extra>",
    )


def _predictions(table: PoseErrorTable, labels: Sequence[str]) -> Any:
    from plotly.graph_objects import Scatter3d

    errors_deg = table.rotation_error_deg.cpu().numpy()
    bar = {"title": {"text": "rotation error [°]", "side": "right"}, "thickness": 14, "len": 0.6, "x": 0.99}
    known_deg = errors_deg[np.isfinite(errors_deg)]
    top_deg = max(1.0, float(np.percentile(known_deg, 95)) if len(known_deg) else 1.0)
    return Scatter3d(
        **_coordinates(table.predicted_position_m.cpu().numpy()),
        mode="markers",
        name="prediction",
        marker={"size": 3.5, "color": errors_deg, "cmin": 0, "cmax": top_deg, "colorscale": _REDS, "colorbar": bar},
        text=labels,
        hovertemplate="%{text}<extra></extra>",
    )


def _labels(names: Sequence[str], errors_m: Iterable[float], errors_deg: Iterable[float]) -> list[str]:
    rows = zip(names, errors_m, errors_deg, strict=True)
    return [f"{html.escape(name)}<br>{error_m:.3f} m<br>{error_deg:.2f}°" for name, error_m, error_deg in rows]


def _offsets(table: PoseErrorTable, labels: Sequence[str]) -> Any:
    """Thin lines from each true position to the predicted one; they end in its marker, so they show the same."""
    from plotly.graph_objects import Scatter3d

    true_m, predicted_m = table.true_position_m.cpu().numpy(), table.predicted_position_m.cpu().numpy()
    ends_m = np.stack((true_m, predicted_m, np.full_like(true_m, np.nan)), axis=1).reshape(-1, 3)
    line = {"color": "rgba(215, 48, 39, 0.35)", "width": 1.5}
    return Scatter3d(
        **_coordinates(ends_m),
        mode="lines",
        line=line,
        showlegend=False,
        text=np.repeat(np.array(labels, dtype=object), 3).tolist(),
        hovertemplate="%{text}<extra></extra>",
    )


def _coordinates(position_m: NDArray[np.floating]) -> dict[str, NDArray[np.floating]]:
    return dict(zip("xyz", position_m.T, strict=True))


def _view(table: PoseErrorTable) -> dict[str, Any]:
    """Axes of one scale, whose longest side is 1, and where they are first seen from.

    Up is the world's axis that the cameras' own up is nearest to, and the longer of the other two runs across.
    """
    limits_m = box_around(table)
    sides = np.ptp(limits_m, axis=1) / np.ptp(limits_m, axis=1).max()
    up = -matrix_from_quaternion(table.true_quaternion.cpu())[..., 1].mean(0).numpy()  # a camera's y points down
    vertical = int(np.abs(up).argmax())
    deep, across = sorted({0, 1, 2} - {vertical}, key=lambda axis: sides[axis])
    above, eye = np.zeros(3), np.zeros(3)
    above[vertical] = np.sign(up[vertical])
    eye[[across, deep, vertical]] = 0.35, 0.9, 0.95 * above[vertical]
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name} [m]"},
            "range": limits.tolist(),
            "backgroundcolor": "#f6f7f8",
            "showspikes": False,
        }
        for name, limits in zip("xyz", limits_m, strict=True)
    }
    camera = {"up": _xyz(above), "eye": _xyz(eye), "center": _xyz(-0.08 * above)}
    return {"aspectmode": "manual", "aspectratio": _xyz(sides), "dragmode": "orbit", "camera": camera, **axes}


def _xyz(vector: NDArray[np.floating]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


_PAGE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
  html, body { height: 100%; margin: 0 }
  body { display: flex; flex-direction: column; font: 15px/1.4 system-ui, sans-serif; color: #1b1f24 }
  header { padding: .7rem 1rem .5rem; border-bottom: 1px solid #ddd }
  h1 { font-size: 1.15rem; margin: 0 }
  p { margin: .15rem 0 0; color: #444; font-size: .93rem }
  main { flex: 1; min-height: 0 }
  main > div { height: 100% }
</style>
<header><h1>$title</h1><p>$summary</p></header>
<main>$plot</main>
</html>
""")
