// The heading of each column, for tables on narrow screens (site.css).
for (const table of document.querySelectorAll("table.docutils")) {
  const headings = [...table.querySelectorAll("thead th")].map((heading) => heading.textContent.trim());
  for (const row of table.querySelectorAll("tbody tr")) {
    [...row.cells].forEach((cell, column) => {
      cell.classList.toggle("blank", !cell.textContent.trim());
      if (column > 0 && headings[column]) cell.dataset.heading = headings[column];
    });
  }
}
