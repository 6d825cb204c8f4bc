// Sort tables by a click on a head, and filter the rows of long ones.
const order = new Intl.Collator(undefined, { numeric: true });
const NUMBER = /^(< )?[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?($|[\s(,/%])/i;
const textOf = (row, column) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();

const sortBy = (table, heads, column) => {
  const falling = heads[column].ariaSort === "ascending", rows = [...table.tBodies[0].rows];
  const texts = rows.map((row) => textOf(row, column)).filter((text) => text && text !== "-");
  const numeric = texts.filter((text) => NUMBER.test(text)).length > texts.length / 2;
  const keyOf = (text) => (!numeric ? text || null : NUMBER.test(text) ? parseFloat(text.replace("< ", "")) : null);
  const keyed = rows.map((row) => ({ row, key: keyOf(textOf(row, column)) }));
  // Cells without a value come last in both directions.
  keyed.sort((a, b) => (a.key === null) - (b.key === null)
    || (falling ? -1 : 1) * (a.key === null ? 0 : numeric ? a.key - b.key : order.compare(a.key, b.key)));
  for (const head of heads) head.ariaSort = null;
  heads[column].ariaSort = falling ? "descending" : "ascending";
  table.tBodies[0].append(...keyed.map(({ row }) => row));
};

for (const table of document.querySelectorAll("table:has(thead)")) {
  const heads = [...table.tHead.rows[0].cells], rows = [...table.tBodies[0].rows];
  if (rows.length > 1) heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    button.addEventListener("click", () => sortBy(table, heads, column));
    head.append(button);
  });
  if (rows.length < 12) continue;
  const field = Object.assign(document.createElement("input"), { type: "search", placeholder: "filter rows", className: "filter" });
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of rows) row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
  });
  table.parentElement.before(field);
}
