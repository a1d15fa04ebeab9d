"""Tables in HTML, for notebooks and for the page of a run."""

import re

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


def rows_of(head, rows):
    """A table with a heading; columns of numbers are aligned to the right. All texts are escaped.

    Parameters
    ----------
    head : sequence of str
    rows : iterable of sequences
        As many entries each as the heading has.
    """
    rows = [tuple(map(str, row)) for row in rows]
    if not rows:
        return "<p>none</p>"
    numeric = [all(_is_number(row[i]) for row in rows) for i in range(len(head))]

    def line(tag, cells):
        marked = (f'<{tag}{" class=n" * n}>{_escaped(c)}</{tag}>' for c, n in zip(cells, numeric, strict=True))
        return f"<tr>{''.join(marked)}</tr>"

    return f"<table>{line('th', head)}{''.join(line('td', row) for row in rows)}</table>"


def lines_of(lines):
    """A table of lines, of which those that begin with a label have it in a column of its own."""
    cells = []
    for line in (line.strip() for line in lines):
        label = LABEL.fullmatch(line)
        left = ' style="text-align: left"'
        cells += [f"<tr><td{left}>{_escaped(label[1])}</td><td{left}>{_escaped(label[2])}</td></tr>"] if label else [
            f'<tr><td colspan="2"{left}>{_escaped(line)}</td></tr>'
        ]
    return f"<table>{''.join(cells)}</table>"


def digits(value, most=6):
    """A number with six digits, or as many as given; a dash where there is none, and no zero with a sign."""
    return "–" if value is None else f"{value + 0.0:.{most}g}"


def _escaped(text):
    from html import escape

    return escape(text)


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return text == "–"
    return True
