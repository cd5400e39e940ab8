"use strict";
// The theme, tables that sort, and paper, which shows what is folded away on a screen.
(() => {
  const root = document.documentElement;
  const prefersDark = window.matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const theme = () => root.dataset.theme || (prefersDark.matches ? "dark" : "light");
  const announce = () => {
    button.textContent = theme() === "dark" ? "Light" : "Dark";
    document.dispatchEvent(new CustomEvent("theme", { detail: theme() }));
  };
  button.hidden = false;
  button.setAttribute("aria-label", "Switch between light and dark");
  button.addEventListener("click", () => {
    root.dataset.theme = theme() === "dark" ? "light" : "dark";
    announce();
  });
  prefersDark.addEventListener("change", announce);
  announce();

  const key = (row, column) => {
    const cell = row.cells[column];
    return "value" in cell.dataset ? Number(cell.dataset.value) : cell.textContent;
  };
  const compare = (one, other) => {
    if (typeof one === "number" && typeof other === "number") return one - other;
    return String(one).localeCompare(String(other), "en", { numeric: true });
  };
  const missing = (value) => value === "" || Number.isNaN(value);
  for (const table of document.querySelectorAll("table.sortable")) {
    const headings = [...table.tHead.rows[0].cells];
    const first = table.tBodies[0].rows[0];
    headings.forEach((heading, column) => {
      if (first && first.cells[column].classList.contains("number")) heading.classList.add("number");
      heading.querySelector("button").addEventListener("click", () => {
        const down = heading.getAttribute("aria-sort") === "ascending";
        headings.forEach((other) => other.removeAttribute("aria-sort"));
        heading.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = [...table.tBodies[0].rows].map((row) => [key(row, column), row]);
        rows.sort(([one], [other]) => {
          if (missing(one) || missing(other)) return missing(one) - missing(other);
          return (down ? -1 : 1) * compare(one, other);
        });
        table.tBodies[0].append(...rows.map(([, row]) => row));
      });
    });
  }

  let opened = [];
  window.addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    opened.forEach((part) => { part.open = true; });
  });
  window.addEventListener("afterprint", () => opened.forEach((part) => { part.open = false; }));
})();
