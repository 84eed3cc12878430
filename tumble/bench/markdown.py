"""The report of a suite as Markdown, which follows from its JSON document alone."""

from tumble.bench import tables
from tumble.bench.plot import line_plots
from tumble.bench.rows import SuiteResults, is_stale


def markdown_of(results: SuiteResults) -> str:
    """The report as Markdown."""
    name, suite = results["name"], results["suite"]
    parts = [
        f"# {suite['title']}",
        facts(results),
        f"`tumble bench run {name}` measures all rows, `tumble bench run {name}"
        f" --only NAME` one of them, and `tumble bench report {name}` writes this file.",
    ]
    parts += [f"![{plot.title}]({plot.file})" for plot in line_plots(results)]
    for table in tables.tables_of(results):
        rule = "|" + "---|" * len(table.headings)
        lines = ["| " + " | ".join(line) + " |" for line in (table.headings, *table.lines)]
        parts += [f"## {table.title}", table.about, "\n".join([lines[0], rule, *lines[1:]])]
    return "\n\n".join(part for part in parts if part) + "\n"


def facts(results: SuiteResults) -> str:
    """What the rows were measured with, in sentences."""
    rows, code, suite = results["rows"], results["code"], results["suite"]
    stale = sum(is_stale(row, results) for row in rows)
    failed = sum("error" in row for row in rows)
    machines = "; ".join(sorted({row["machine"] for row in rows if row["machine"]})) or tables.NOTHING
    sentences = [
        f"{len(rows)} of {len(results['cases'])} rows: {failed} failed, {stale} stale (measured with other code).",
        f"Code: version {code['version']}, commit {code['commit'] or 'unknown'}, sources {code['fingerprint']}.",
        f"Machine: {machines}.",
    ]
    if suite["half"] == "tune":
        sentences.append("Objects of this suite were used to choose constants of the method.")
    if suite["half"] == "report":
        frozen = f"were frozen at commit {suite['frozen']}" if suite["frozen"] else "are not frozen yet"
        sentences.append(f"No constant of the method was chosen on these objects; the constants {frozen}.")
    return " ".join(sentences)
