"""A report's sections as Markdown, CSV, LaTeX, and one page that fetches nothing, with tables to sort."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files

import matplotlib
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Args:
        name: of its table's files; empty where it has none.
        title: heads it.
        text: under the title.
        table: a header and lines of text.
        footnotes: under the table.
        plot: as SVG.
        folded: on the page, shown when asked for.
    """

    name: str
    title: str
    text: str
    table: list[list[str]] | None = None
    footnotes: list[str] = field(default_factory=list)
    plot: str | None = None
    folded: bool = False

    @property
    def anchor(self) -> str:
        """Its name in addresses and files."""
        return self.name or re.sub(r"\W+", "_", self.title.lower())


def as_csv(table: list[list[str]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(table)
    return text.getvalue()


def as_svg(figure: Figure) -> str:
    """A plot as SVG, the same to the byte each time."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "mambaloc"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


_LATEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"±": r"$\pm$", "°": r"\textdegree{}", "\N{GREEK SMALL LETTER SIGMA}": r"$\sigma$"},
}


def as_latex(section: Section) -> str:
    """A section's table for ``\\usepackage{booktabs}``."""
    header, *lines = [[_escaped(cell) for cell in line] for line in section.table or []]
    rows = [" & ".join(line) + r" \\" for line in lines]
    notes = [rf"\par\footnotesize {_escaped(note)}" for note in section.footnotes]
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{_escaped(section.title)}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}",
            r"\toprule",
            " & ".join(header) + r" \\",
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            *notes,
            r"\end{table}",
            "",
        ]
    )


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)


def as_markdown(introduction: str, sections: Sequence[Section]) -> str:
    """All sections; plots as the files of their anchors in ``plots/``."""
    parts = ["# Results", introduction]
    for section in sections:
        parts += [f"## {section.title}", section.text]
        if section.table:
            parts.append(_markdown_table(section.table))
        if section.plot:
            parts.append(f"![{section.title}](plots/{section.anchor}.svg)")
        parts.append("\n".join(f"- {note}" for note in section.footnotes))
    return "\n\n".join(part for part in parts if part) + "\n"


def _markdown_table(lines: list[list[str]]) -> str:
    escaped = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    rows = [f"| {' | '.join(line)} |" for line in escaped]
    return "\n".join([rows[0], "|" + "---|" * len(lines[0]), *rows[1:]])


def as_page(introduction: str, sections: Sequence[Section]) -> str:
    """All sections as one HTML file."""
    links = " ".join(f'<a href="#{section.anchor}">{html.escape(section.title)}</a>' for section in sections)
    body = "\n".join([f"<p>{html.escape(introduction)}</p>", f"<nav>{links}</nav>", *map(_html_section, sections)])
    page = files("mambaloc.sweep").joinpath("page.html").read_text(encoding="utf-8")
    return page.replace("BODY", body)


def _html_section(section: Section) -> str:
    parts = [f"<p>{html.escape(section.text)}</p>"] if section.text else []
    if section.table:
        parts.append(_html_table(section.table))
    if section.plot:
        parts.append(f"<figure>{section.plot}</figure>")
    if section.footnotes:
        parts.append(f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in section.footnotes)}</ul>")
    title = f'<h2 id="{section.anchor}">{html.escape(section.title)}</h2>'
    if section.folded:
        return f"<details><summary>{title}: nothing of ours yet</summary>{''.join(parts)}</details>"
    return title + "".join(parts)


def _html_table(lines: list[list[str]]) -> str:
    """A column with any number in it stands to the right, whole."""
    kinds = ["number" if any(map(_is_number, column[1:])) else "text" for column in zip(*lines, strict=True)]
    head = _html_row("th", "header", kinds, [f"<button>{html.escape(cell)}</button>" for cell in lines[0]])
    body = "".join(
        _html_row("td", "printed" if line[0].endswith(", paper") else "own", kinds, map(html.escape, line))
        for line in lines[1:]
    )
    return f"<div><table><thead>{head}</thead><tbody>{body}</tbody></table></div>"


def _html_row(tag: str, kind: str, kinds: Sequence[str], cells: Iterable[str]) -> str:
    content = "".join(f"<{tag} class={each}>{cell}</{tag}>" for each, cell in zip(kinds, cells, strict=True))
    return f"<tr class={kind}>{content}</tr>"


def _is_number(text: str) -> bool:
    return re.match(r"[+-]?\d", text) is not None
