"""What was found, for people: ``report.md`` and its plots in the scene's folder, a table in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from mambaloc.importing.canonical import ADJUSTED_FILE, Imported
from mambaloc.importing.checks.agreement import Agreement
from mambaloc.importing.checks.conventions import up_of
from mambaloc.importing.checks.depth import SCALES
from mambaloc.importing.checks.epipolar import FOCALS, NEAR_PX, Bin
from mambaloc.importing.motion import motion_of
from mambaloc.importing.splits.selection import RULE, SplitCandidate
from mambaloc.viz.agreement import draw_agreement
from mambaloc.viz.capture import draw_capture

REPORT_FILE, PLOT_FILE, AGREEMENT_FILE = "report.md", "trajectory.png", "agreement.png"
_IN_TERMINAL = (
    "frames", "poses", "images and poses", "focal length", "depth", "adjusted poses", "up", "steps", "extent",
)  # fmt: skip


def write_report(imported: Imported, folder: Path, name: str) -> None:
    """Write ``report.md``, ``trajectory.png`` and, where images were compared with poses, ``agreement.png``.

    Args:
        imported: what was found.
        folder: where to.
        name: of the scene.
    """
    (folder / REPORT_FILE).write_text(_page(imported, name), encoding="utf-8")
    capture = imported.capture
    if len(capture.images) < 2:
        return
    up, motion = up_of(capture), motion_of(capture)
    by = f", split by {imported.chosen.proposal.kind}" if imported.chosen else ""
    draw_capture(
        capture.world_from_cam[:, :3, 3],
        capture.world_from_cam[:, :3, 2],
        up.direction if up.world_axis is None else up.world_axis,
        imported.split,
        capture.sequences,
        motion.jumps.tolist(),
        folder / PLOT_FILE,
        f"{name}: {len(capture.images)} frames{by}",
        imported.unit,
    )
    if (found := imported.agreement) is not None and found.is_known:
        depth = found.depth
        draw_agreement(
            [(_between(each), each.share, each.possible, each.adjusted) for each in found.bins],
            (FOCALS * found.focal_px, found.focal_share, found.focal_px, found.focal * found.focal_px),
            None if depth is None else (SCALES, depth.focal_px, depth.turn_px),
            folder / AGREEMENT_FILE,
            f"{name}: do the poses agree with the images?",
            imported.unit,
        )


def print_summary(imported: Imported, folder: Path) -> None:
    """Print the verdict, what it rests on, and the proposals."""
    console = Console(highlight=False)
    lead, reasons = imported.verdict.in_words()
    for line in (f"{folder}: {lead}", *(f"- {reason}" for reason in reasons)):
        console.print(line, soft_wrap=True, markup=False)
    found = {finding.name: finding.message for finding in imported.findings}
    table = Table(box=None, show_header=False, pad_edge=False)
    for name in _IN_TERMINAL:
        if name in found:
            table.add_row(name, found[name])
    console.print(table, markup=False)
    if imported.chosen is None:
        return
    console.print(_proposals(imported))
    console.print(f"chosen: {imported.chosen.proposal.kind}, {imported.chosen.why}", soft_wrap=True)
    training = f"mambaloc train my_scene --data.scene {folder}"
    console.print(
        f"wrote {folder}: {REPORT_FILE}, {PLOT_FILE}, {AGREEMENT_FILE}; next: {training}", soft_wrap=True, markup=False
    )


_TABLE_TITLE = "from test frames to the nearest training frame"


def _proposals(imported: Imported) -> Table:
    """Three lines a proposal: distances in the capture's unit, in degrees, in steps."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title=_TABLE_TITLE, title_justify="left")
    for column in ("split by", "train/val/test", "near", "", "", "10 %", "median", "90 %"):
        table.add_column(column, justify="right" if column[-1:] in ("%", "n") or column == "near" else "left")
    for proposal in imported.proposals:
        style = "bold" if imported.chosen and proposal is imported.chosen.proposal else ""
        names: tuple[str, ...] = (proposal.kind, _counts(proposal), f"{proposal.near:.0%}", _quality(proposal))
        for unit, quantiles in _distances(proposal, imported.unit).items():
            table.add_row(*names, unit, *map(_short, quantiles), style=style)
            names = ("", "", "", "")
    return table


def _distances(proposal: SplitCandidate, unit: str) -> dict[str, tuple[float, float, float]]:
    return {unit: proposal.length, "deg": proposal.turn_deg, "steps": proposal.steps}


def _counts(proposal: SplitCandidate) -> str:
    return "/".join(str(proposal.counts[split]) for split in ("train", "val", "test"))


def _quality(proposal: SplitCandidate) -> str:
    faults = [word for word, holds in (("leaks", not proposal.is_leak_free), ("far", not proposal.is_covered)) if holds]
    return ", ".join(faults) or "good"


def _spans(proposal: SplitCandidate) -> list[str]:
    return [f"{_short(b)} ({_short(a)} to {_short(c)})" for a, b, c in _distances(proposal, "").values()]


def _short(number: float) -> str:
    return f"{number:.0f}" if number >= 99.5 else f"{number:.2g}"


def _page(imported: Imported, name: str) -> str:
    capture = imported.capture
    parts = [f"# {name}", _verdict(imported), f"![Cameras from above and from the side]({PLOT_FILE})", "## Found"]
    parts.append(_table(("check", "found"), [(finding.name, finding.message) for finding in imported.findings]))
    if imported.agreement is not None and imported.agreement.is_known:
        parts += _of_agreement(imported.agreement, imported.unit)
    parts.append("## Split")
    if imported.chosen is None:
        parts.append("None: nothing can be split.")
    else:
        chosen = imported.chosen
        parts.append(f"By **{chosen.proposal.kind}**: {chosen.proposal.how}; {chosen.why}.")
        parts += [f"**Warning:** {chosen.warning}."] if chosen.warning else []
        parts.append(f"{_TABLE_TITLE[0].upper()}{_TABLE_TITLE[1:]}: median (10 % to 90 %).")
        header = ("split by", "train/val/test", "near", "", *_distances(chosen.proposal, imported.unit))
        rows = [
            (each.kind, _counts(each), f"{each.near:.0%}", _quality(each), *_spans(each)) for each in imported.proposals
        ]
        parts.append(_table(header, rows))
        parts += [f"- {proposal.kind}: {proposal.how}" for proposal in imported.proposals]
        parts.append(RULE)
    parts.append("## Decided")
    unit = "metres" if capture.unit == "metre" else "unknown: figures printed as metres are units of this scene"
    parts.append(_table(("of", "decided"), [("format", capture.kind), ("unit", unit), *capture.choices.items()]))
    if imported.left_out:
        parts.append("## Left out")
        parts.append(_table(("image", "rule"), [(Path(file).name, rule) for file, rule in imported.left_out.items()]))
    return "\n\n".join(parts) + "\n"


def _of_agreement(found: Agreement, unit: str) -> list[str]:
    """The section on poses and images."""
    header = ["baseline", "turn", "pairs", "matches", "agree", "could agree"]
    rows = [
        [f"{_between(each)} {unit}", f"{each.turn_deg:.0f}°", str(each.pairs), str(each.matches), f"{each.share:.0%}",
         f"{each.possible:.0%}"]
        for each in found.bins
    ]  # fmt: skip
    parts = [
        "## Poses and images",
        f"![Matches that agree, by baseline and by focal length]({AGREEMENT_FILE})",
        f"A match agrees where it lies within {NEAR_PX:g} px of the line that the poses draw for it, were the longer "
        "side of the images 640 px. It could agree where a pose fitted to its two images alone explains it: the "
        "rest is wrongly matched. Where much less agrees than could, poses or intrinsics are off.",
    ]
    if found.adjusted is not None:
        header.append("agree, adjusted")
        for row, each in zip(rows, found.bins, strict=True):
            row.append(f"{each.adjusted:.0%}")
    parts.append(_table(tuple(header), [tuple(row) for row in rows]))
    parts.append(
        "The focal length is tried with the poses as they are. A focal length that is too long and turns that are too "
        "small look alike in matches"
        + ("; depth distinguishes them better." if found.depth else ", unless there is depth.")
    )
    if (adjusted := found.adjusted) is not None:
        held = "the given poses and depth" if adjusted.with_depth else "the given poses"
        parts.append(
            f"`{ADJUSTED_FILE}` has adjusted poses, which nothing uses unless it is renamed to `frames.csv`. They are "
            f"held by {held}: images alone prefer turns that are too small where baselines are small, and bend the "
            f"map. Here turns between frames are {adjusted.turns:.3g} of those given."
        )
        if adjusted.focal:
            parts.append(
                "It names cameras whose focal length was adjusted with the poses, held by the given one to 2 %. They "
                "come into use with the poses:"
            )
            scales = [(name, f"{scale:.4f}") for name, scale in adjusted.focal.items()]
            parts.append(_table(("camera", "adjusted focal length over the given"), scales))
    return parts


def _between(each: Bin) -> str:
    if np.isinf(each.high):
        return f"over {each.low:g}"
    return f"{each.low:g} to {each.high:g}" if each.low else f"under {each.high:g}"


def _verdict(imported: Imported) -> str:
    lead, reasons = imported.verdict.in_words()
    return "\n".join([f"**{lead}**", "", *(f"- {reason}" for reason in reasons)]).strip()


def _table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [header, tuple("---" for _ in header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines
    )
