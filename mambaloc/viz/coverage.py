"""A sparse map from above: where a camera would find itself, where it would be lost, and what to film next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mambaloc.mapping.coverage import Outlook
from mambaloc.runtime.maps import SparseMap
from mambaloc.runtime.maps.viewpoints import spread_m
from mambaloc.viz.capture import plot_axes
from mambaloc.viz.png import write_png

Floats = NDArray[np.float64]

_HEADINGS = 12
_PLACES = 14  # across a square of the area that is drawn
_REACH = 0.6  # of the key frames' spread; how far around them to look
_NEIGHBOURS = 4  # key frames whose height and tilt a place takes
_UPRIGHT_DEG = 25.0
_MAX_GAPS = 3
_COLORS = LinearSegmentedColormap.from_list("coverage", ("#b2182b", "#ef8a62", "#fee08b", "#66bd63", "#1a7837"))
_POINT, _KEY_FRAME, _GAP = "#9a9a9a", "#1f3b6f", "#111111"
_WIDTH_IN, _PLOT_IN = 8.0, 6.4
_MAX_MARGIN = 0.5  # of the longer side of the places


@dataclass(frozen=True)
class Gap:
    """A place and a direction where a camera would be lost, the middle of a region of such.

    Args:
        place: in the plane that is drawn.
        direction: of view, of unit length.
        matches: points that a camera there may be expected to match.
    """

    place: Floats
    direction: Floats
    matches: float


@dataclass(frozen=True)
class Survey:
    """What cameras see of a map from places around its key frames, at their height, in every direction.

    Shape:
        ``axes`` (3, 3): rows are two level directions and up; ``places`` (G, 2) along the first two; ``headings``
        (H,) in radians from the first towards the second; ``matches`` and ``certainty`` (G, H).

    Args:
        names: of the axes.
        step: from one place to the next.
        certainty: 0 where a camera would be lost, 1 where it has plenty.
    """

    axes: Floats
    names: list[str]
    places: Floats
    step: float
    headings: Floats
    matches: Floats
    certainty: Floats


def write_coverage(sparse_map: SparseMap, path: Path) -> str:
    """Draw a map's coverage, and say what to film next, one line each.

    Args:
        sparse_map: the map.
        path: the PNG to write.
    """
    found = survey(sparse_map)
    chosen = gaps(found, sparse_map.key_poses[:, :3, 3] @ found.axes[:2].T)
    draw_coverage(sparse_map, found, chosen, path)
    return describe_gaps(found, chosen)


def survey(sparse_map: SparseMap) -> Survey:
    """Look around in a map."""
    poses = sparse_map.key_poses
    position, unit = poses[:, :3, 3], spread_m(poses)
    level, names = plot_axes(position, upwards(poses))
    axes = np.stack(level)
    walked = position @ axes[:2].T
    places, step = _grid(walked, _REACH * unit)
    headings = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    outlook = Outlook(sparse_map)
    matches, deviation = np.empty((2, len(places), _HEADINGS))
    for row, place in enumerate(places):
        nearest = np.argsort(((walked - place) ** 2).sum(axis=1), kind="stable")[:_NEIGHBOURS]
        height, tilt = (position[nearest] @ axes[2]).mean(), np.arcsin((poses[nearest, :3, 2] @ axes[2]).mean())
        matches[row], deviation[row] = outlook.of(
            np.array([*place, height]) @ axes, _level_cameras(axes, headings, float(tilt))
        )
    return Survey(axes, names, places, step, headings, matches, np.asarray(outlook.certainty(matches, deviation)))


def gaps(found: Survey, walked: Floats) -> list[Gap]:
    """Say where to film next: up to three places and directions where a camera would be lost, beside some where not.

    From there a video starts in what the map knows, as growing it needs.

    Args:
        found: the survey.
        walked: where the key frames are, (K, 2) in its plane; what is near them counts most.
    """
    distance = np.sqrt(((found.places[:, None] - found.places) ** 2).sum(axis=2)) / found.step
    off = np.sqrt(((found.places[:, None] - walked) ** 2).sum(axis=2)).min(axis=1)
    nearby = np.exp(-((distance / 2) ** 2))
    lost, known = (nearby @ _blurred(each) for each in ((1 - found.certainty) ** 2, found.certainty**2))
    region = lost * known * (1 - found.certainty) * np.exp(-((off / (2 * found.step)) ** 2))[:, None]
    chosen: list[Gap] = []
    for _ in range(_MAX_GAPS):
        place, heading = np.unravel_index(int(region.argmax()), region.shape)
        if found.certainty[place, heading] > 0.5:
            break
        angle = found.headings[heading]
        direction = np.array([np.cos(angle), np.sin(angle)])
        chosen.append(Gap(found.places[place], direction, float(found.matches[place, heading])))
        region *= 1 - np.exp(-((distance[place, :, None] / 4) ** 4))
    return chosen


def _blurred(values: Floats) -> Floats:
    """Sums over neighbouring headings, (G, H)."""
    turns = ((-2, 0.5), (-1, 1.0), (0, 1.0), (1, 1.0), (2, 0.5))
    return np.asarray(sum(weight * np.roll(values, shift, axis=1) for shift, weight in turns))


def describe_gaps(found: Survey, chosen: list[Gap]) -> str:
    """Gaps in words, one line each."""
    if not chosen:
        return "no gaps: a camera would find itself everywhere around the key frames"
    lines = []
    for number, gap in enumerate(chosen, start=1):
        place = ", ".join(_coordinate(name, value) for name, value in zip(found.names, gap.place, strict=False))
        lines.append(
            f"film next {number}: from {place}, looking towards {_direction(gap.direction, found.names)}, "
            f"where about {gap.matches:.0f} points would be matched"
        )
    return "\n".join(lines)


def draw_coverage(sparse_map: SparseMap, found: Survey, chosen: list[Gap], path: Path) -> None:
    """Draw a survey from above.

    Args:
        sparse_map: the map.
        found: its survey.
        chosen: what to film next, numbered.
        path: the PNG to write.
    """
    points = sparse_map.points_m @ found.axes[:2].T
    low, high = _limits(found, points)
    height_in = float(np.clip(_PLOT_IN * (high - low)[1] / (high - low)[0], 3.0, 8.0)) + 1.4
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.scatter(points[:, 0], points[:, 1], s=3, color=_POINT, linewidths=0, zorder=1)
    _draw_discs(axes, found)
    _draw_key_frames(axes, sparse_map, found)
    _draw_gaps(axes, found, chosen)
    axes.set(xlabel=f"{found.names[0]} [m]", ylabel=f"{found.names[1]} [m]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6))
    axes.set_title(f"{sparse_map.scene}: where a camera would find itself", fontsize=11, loc="left")
    bar = figure.colorbar(ScalarMappable(Normalize(0, 1), _COLORS), ax=axes, shrink=0.6, aspect=30, pad=0.02)
    bar.set_ticks([0.0, 0.5, 1.0], labels=["lost", "unsure", "sure"])
    _draw_legend(figure)
    write_png(figure, path)


def _limits(found: Survey, points: Floats) -> tuple[Floats, Floats]:
    """The places and most of the points; at most half as much again on each side."""
    low, high = found.places.min(axis=0) - found.step, found.places.max(axis=0) + found.step
    max_margin = _MAX_MARGIN * (high - low).max()
    outer_low, outer_high = np.quantile(points, (0.03, 0.97), axis=0)
    return np.clip(outer_low, low - max_margin, low), np.clip(outer_high, high, high + max_margin)


def upwards(world_from_cam: Floats) -> Floats:
    """Where up is in the world, (3,), for cameras (N, 4, 4) held upright on average; an axis of the world if near."""
    up = -world_from_cam[:, :3, 1].mean(axis=0)
    up = up / max(np.linalg.norm(up), 1e-12)
    nearest = int(np.abs(up).argmax())
    is_near = np.abs(up[nearest]) >= np.cos(np.radians(_UPRIGHT_DEG))
    return np.asarray(np.eye(3)[nearest] * np.sign(up[nearest]) if is_near else up)


def _grid(walked: Floats, reach: float) -> tuple[Floats, float]:
    """Places within reach of what was walked, (G, 2), and the step between them."""
    low, high = walked.min(axis=0) - reach, walked.max(axis=0) + reach
    step = float(np.sqrt(np.prod(high - low))) / _PLACES
    counts = np.ceil((high - low) / step).astype(int)
    start = (low + high - (counts - 1) * step) / 2
    places = np.stack(np.meshgrid(*(start[k] + step * np.arange(counts[k]) for k in (0, 1))), axis=-1).reshape(-1, 2)
    off = np.sqrt(((places[:, None] - walked) ** 2).sum(axis=2)).min(axis=1)
    return places[off <= reach], step


def _level_cameras(axes: Floats, headings: Floats, tilt: float) -> Floats:
    """Rotations ``world_from_cam`` (H, 3, 3) of cameras without roll."""
    level = np.cos(headings)[:, None] * axes[0] + np.sin(headings)[:, None] * axes[1]
    forward = np.cos(tilt) * level + np.sin(tilt) * axes[2]
    right = np.cross(level, axes[2])
    return np.stack((right, np.cross(forward, right), forward), axis=-1)


def _draw_discs(axes: Axes, found: Survey) -> None:
    half = 180 / len(found.headings)
    slices = [
        Wedge(tuple(place), 0.47 * found.step, angle - half, angle + half)
        for place in found.places
        for angle in np.degrees(found.headings)
    ]
    discs = PatchCollection(slices, cmap=_COLORS, edgecolor="white", linewidth=0.25, zorder=2)
    discs.set_array(found.certainty.ravel())
    discs.set_clim(0, 1)
    axes.add_collection(discs)


def _draw_key_frames(axes: Axes, sparse_map: SparseMap, found: Survey) -> None:
    place = sparse_map.key_poses[:, :3, 3] @ found.axes[:2].T
    forward = sparse_map.key_poses[:, :3, 2] @ found.axes[:2].T
    wedges = [
        Wedge(tuple(at), 0.5 * found.step, angle - 16, angle + 16)
        for at, angle in zip(place, np.degrees(np.arctan2(forward[:, 1], forward[:, 0])), strict=True)
    ]
    axes.add_collection(
        PatchCollection(wedges, facecolor=_KEY_FRAME, edgecolor="white", linewidth=0.3, alpha=0.55, zorder=3)
    )
    axes.scatter(place[:, 0], place[:, 1], s=7, color=_KEY_FRAME, linewidths=0, zorder=4)


def _draw_gaps(axes: Axes, found: Survey, chosen: list[Gap]) -> None:
    for number, gap in enumerate(chosen, start=1):
        end = gap.place + 1.6 * found.step * gap.direction
        arrow = {"arrowstyle": "-|>", "color": _GAP, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (end[0], end[1]), (gap.place[0], gap.place[1]), arrowprops=arrow, zorder=5)
        axes.text(
            gap.place[0], gap.place[1], str(number), ha="center", va="center", color="white", fontsize=9, zorder=6,
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": _GAP, "edgecolor": "white", "linewidth": 0.8},
        )  # fmt: skip


def _draw_legend(figure: Figure) -> None:
    handles = [
        Line2D([], [], color=_KEY_FRAME, marker="o", markersize=4, linestyle="", label="key frame and where it looks"),
        Line2D([], [], color=_POINT, marker=".", markersize=4, linestyle="", label="point of the map"),
        Line2D([], [], color=_GAP, marker=r"$\rightarrow$", markersize=11, linestyle="", label="film next"),
    ]
    legend = figure.legend(
        handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9,
        title="Each disc is a place, each slice of it a direction of view.",
    )  # fmt: skip
    legend.get_title().set_fontsize(9)


def _direction(direction: Floats, names: list[str]) -> str:
    parts = [_signed(name, part) for part, name in zip(direction, names, strict=False) if abs(part) > np.sin(np.pi / 8)]
    return " ".join(parts)


def _signed(name: str, part: float) -> str:
    return f"{'+' if (part > 0) != name.startswith('-') else '-'}{name.removeprefix('-')}"


def _coordinate(name: str, value: float) -> str:
    return f"{name.removeprefix('-')} {-value if name.startswith('-') else value:.1f}"
