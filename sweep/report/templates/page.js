"use strict";
// The theme, sortable tables, and printing, which also shows what is folded on a screen.
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

  // A table that is wider than its place becomes a list of rows, so that no column is out of sight.
  const fit = () => {
    for (const table of document.querySelectorAll("table.sortable")) {
      table.classList.remove("cards");
      const place = table.parentElement;
      if (place.clientWidth && table.scrollWidth > place.clientWidth + 1) table.classList.add("cards");
    }
  };
  let printing = false;
  let width = 0;
  const fitAgain = () => { if (!printing && document.body.clientWidth !== width) { width = document.body.clientWidth; fit(); } };
  window.addEventListener("resize", fitAgain);
  document.addEventListener("toggle", fit, true);
  fit();

  const save = (name, content, type) => {
    const link = document.createElement("a");
    link.href = content instanceof Blob ? URL.createObjectURL(content) : content;
    link.download = `${name}.${type}`;
    link.click();
    if (content instanceof Blob) setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  // A quote stands before what a spreadsheet would compute.
  const inert = (text) => (/^\s*[=+\-@＝＋－＠]/.test(text) && isNaN(text) ? `'${text}` : text);
  const quoted = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const csv = (table) => {
    const heads = [...table.tHead.rows[0].cells].map((cell) => cell.textContent);
    const rows = [...table.tBodies[0].rows].filter((row) => !row.hidden).map((row) => [...row.cells].map((cell) => cell.dataset.value ?? cell.textContent));
    return [heads, ...rows].map((row) => row.map(inert).map(quoted).join(",")).join("\n") + "\n";
  };
  // A picture to save: in light colours, and independent of the page.
  const alone = (svg) => {
    const copy = svg.cloneNode(true);
    const [, , w, h] = (copy.getAttribute("viewBox") || "0 0 640 440").split(/\s+/).map(Number);
    copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
    copy.setAttribute("width", `${w}pt`);
    copy.setAttribute("height", `${h}pt`);
    const text = new XMLSerializer().serializeToString(copy).replace(/light-dark\((#[0-9a-f]{6}), [^)]*\)+/g, "$1");
    return { text, w, h };
  };
  const png = (name, svg) => {
    const { text, w, h } = alone(svg);
    const image = new Image();
    image.onload = () => {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [4 * w, 4 * h];
      const pen = canvas.getContext("2d");
      pen.fillStyle = "#ffffff";
      pen.fillRect(0, 0, canvas.width, canvas.height);
      pen.drawImage(image, 0, 0, canvas.width, canvas.height);
      save(name, canvas.toDataURL("image/png"), "png");
    };
    image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  };
  for (const one of document.querySelectorAll("button.csv, button.svg, button.png")) {
    one.hidden = false;
    one.setAttribute("aria-label", `Save ${one.dataset.name} as ${one.textContent}`);
    one.addEventListener("click", () => {
      const name = one.dataset.name;
      if (one.classList.contains("csv")) {
        save(name, new Blob([csv(one.closest("details").querySelector("table"))], { type: "text/csv" }), "csv");
        return;
      }
      const svg = one.closest("figure").querySelector("svg");
      if (one.classList.contains("png")) png(name, svg);
      else save(name, new Blob([alone(svg).text], { type: "image/svg+xml" }), "svg");
    });
  }

  let opened = [];
  window.addEventListener("beforeprint", () => {
    printing = true;
    document.querySelectorAll("table.cards").forEach((table) => table.classList.remove("cards"));
    opened = [...document.querySelectorAll("details:not([open])")];
    opened.forEach((part) => { part.open = true; });
  });
  window.addEventListener("afterprint", () => { printing = false; fit(); });
  window.addEventListener("afterprint", () => opened.forEach((part) => { part.open = false; }));
})();
