"""How values print themselves: lines of text, and tables in HTML for notebooks and for the page of a run."""

import re
from math import inf

WIDTH, MOST_LINES = 118, 8  # of a printed value
EXTREMA = ("signal", "least", "at t [s]", "greatest", "at t [s]", "unit")
LABEL = re.compile(r"([^;:()=]{1,40}): (.+)")  # a line of a printed value that begins with what it is about


class Shown:
    """A value that notebooks show as a small table: what it prints, line by line, unless `_tables` has other rows."""

    def _tables(self):
        """Pairs of a heading and rows (`rows_of`), and what stays as lines."""
        return [], repr(self).splitlines()[1:]

    def _repr_html_(self):
        tables, lines = self._tables()
        caption = f"<p><b>{_escaped(repr(self).splitlines()[0])}</b></p>"
        return caption + "".join(rows_of(*table) for table in tables) + (lines_of(lines) if lines else "")


class Detailed(Shown):
    """A value that prints its `_lines(full=False)`, as far as there is room, and has those with full in `details`."""

    @property
    def details(self) -> str:
        """All that the value says about itself, as text; printed, it says what is needed first."""
        return "\n".join(self._lines(full=True))

    def __repr__(self):
        lines = self._lines(full=False)
        if (more := len(lines) - MOST_LINES + 1) > 1:
            lines[MOST_LINES - 1 :] = [f"  and {more} more in .details"]
        return "\n".join(lines)


def fitted(line, full=False):
    """The text `line(room)` with as much room for each of its lists as keeps it within a line; if full, with all."""
    texts = map(line, [inf] if full else range(WIDTH, -1, -1))
    return next((text for text in texts if full or len(text) <= WIDTH), line(0))


def listed(texts, room, apart=", ", unit=""):
    """Texts in a row, as many as there is room for, one at least; the others are counted."""
    row, texts = apart.join(texts) + unit, list(texts)
    for shown in range(min(len(texts), WIDTH) - 1, 0, -1):
        if len(row) <= room:
            break
        row = f"{apart.join(texts[:shown])}{unit} and {len(texts) - shown} more"
    return row


def rows_of(head, rows):
    """A table with a heading; columns of numbers are aligned to the right. All texts are escaped.

    Each row has as many entries as the heading; without rows there is a paragraph "none" instead.
    """
    rows = [tuple(map(str, row)) for row in rows]
    if not rows:
        return "<p>none</p>"
    numeric = [all(_is_number(row[i]) for row in rows) for i in range(len(head))]

    def line(tag, cells):
        marked = (f"<{tag}{' class=n' * n}>{_escaped(c)}</{tag}>" for c, n in zip(cells, numeric, strict=True))
        return f"<tr>{''.join(marked)}</tr>"

    return f"<table>{line('th', head)}{''.join(line('td', row) for row in rows)}</table>"


def lines_of(lines):
    """A table of lines, of which those that begin with a label have it in a column of its own."""
    cells = []
    for line in (line.strip() for line in lines):
        label = LABEL.fullmatch(line)
        left = ' style="text-align: left"'
        cells += (
            [f"<tr><td{left}>{_escaped(label[1])}</td><td{left}>{_escaped(label[2])}</td></tr>"]
            if label
            else [f'<tr><td colspan="2"{left}>{_escaped(line)}</td></tr>']
        )
    return f"<table>{''.join(cells)}</table>"


def digits(value, most=6):
    """A number with six digits, or as many as given; a dash where there is none or NaN, and no zero with a sign."""
    return "–" if value is None or value != value else f"{value + 0.0:.{most}g}"


def _escaped(text):
    from html import escape

    return escape(text)


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return text == "–"
    return True
