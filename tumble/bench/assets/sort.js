// A click on a heading sorts the table by that column: numbers by value, other text by the alphabet.
for (const table of document.querySelectorAll("table.sortable")) {
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((heading, column) => heading.addEventListener("click", () => {
    const ascending = heading.getAttribute("aria-sort") !== "ascending";
    headings.forEach((other) => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const body = table.tBodies[0], text = (row) => row.cells[column].textContent;
    const order = (a, b) => {
      const x = parseFloat(text(a)), y = parseFloat(text(b));
      if (Number.isNaN(x) !== Number.isNaN(y)) return Number.isNaN(x) ? 1 : -1;
      const difference = Number.isNaN(x) ? text(a).localeCompare(text(b)) : x - y;
      return ascending ? difference : -difference;
    };
    body.append(...[...body.rows].sort(order));
  }));
}
