// Sorting, finding, and pictures that turn under the pointer.
"use strict";
const body = document.querySelector("tbody"), heads = [...document.querySelectorAll("thead th")];
heads.forEach((head, column) => {
  head.tabIndex = 0;
  const sort = () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    const value = (row) => row.cells[column].dataset.value;
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === "" || y === "") return (x === "") - (y === ""); // what has no figure stays below
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, undefined, { numeric: true }) : x - y;
      return down ? -order : order;
    });
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    body.append(...rows);
  };
  head.addEventListener("click", sort);
  head.addEventListener("keydown", (event) => event.key === "Enter" && sort());
});
document.querySelector(".find").addEventListener("input", (event) => {
  const wanted = event.target.value.toLowerCase();
  for (const row of body.rows) row.hidden = !row.cells[0].textContent.toLowerCase().includes(wanted);
});
for (const thumb of document.querySelectorAll(".thumb")) {
  const { count, columns, rows } = thumb.dataset;
  const show = (frame) => {
    const column = frame % columns, row = Math.floor(frame / columns);
    thumb.style.backgroundPosition = `${columns > 1 ? (100 * column) / (columns - 1) : 0}% ${rows > 1 ? (100 * row) / (rows - 1) : 0}%`;
  };
  const first = Math.floor(count / 8);
  show(first);
  thumb.addEventListener("pointermove", (event) => show(Math.min(count - 1, Math.max(0, Math.floor((event.offsetX / thumb.offsetWidth) * count)))));
  thumb.addEventListener("pointerleave", () => show(first));
}
