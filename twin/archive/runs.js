"use strict";
const rows = JSON.parse(document.getElementById("data").textContent);
const table = document.getElementById("runs");
const lines = [...table.tBodies[0].rows].filter((line) => line.dataset.row !== undefined);
const rowOf = (line) => rows[line.dataset.row];
const box = (line) => line.querySelector("input");
const svg = document.getElementById("trend");
const quantity = document.getElementById("quantity");
const compare = { "=": (a, b) => a === b, "!=": (a, b) => a !== b, "<": (a, b) => a < b,
  "<=": (a, b) => a <= b, ">": (a, b) => a > b, ">=": (a, b) => a >= b };

function add(parent, name, attributes = {}, text = "") {
  const space = parent instanceof SVGElement ? "http://www.w3.org/2000/svg" : "http://www.w3.org/1999/xhtml";
  const element = document.createElementNS(space, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text;
  return parent.appendChild(element);
}
function show(value) {
  if (value === null || value === undefined || value === "") return "–";
  if (Array.isArray(value)) return value.join(", ");
  return typeof value === "number" && !Number.isInteger(value) ? Number(value.toPrecision(5)).toString() : String(value);
}
function meets(line, word) {
  const condition = word.match(/^(\w+)(<=|>=|!=|=|<|>)(.+)$/);
  if (!condition || !rows.some((row) => condition[1] in row)) return line.textContent.toLowerCase().includes(word.toLowerCase());
  const value = rowOf(line)[condition[1]];
  if (value === null || value === undefined) return false;
  return typeof value === "number" ? compare[condition[2]](value, Number(condition[3])) : compare[condition[2]](show(value), condition[3]);
}
function filter() {
  const words = document.getElementById("filter").value.split(/\s+/).filter(Boolean);
  for (const line of lines) line.hidden = !words.every((word) => meets(line, word));
  document.getElementById("count").textContent = `${lines.filter((line) => !line.hidden).length} of ${rows.length} runs`;
  drawTrend();
}
function sortBy(head) {
  const key = head.dataset.key, down = head.getAttribute("aria-sort") !== "descending" ? -1 : 1;
  for (const other of table.tHead.querySelectorAll("th")) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down < 0 ? "descending" : "ascending");
  const order = (a, b) => {
    const [x, y] = [rowOf(a)[key], rowOf(b)[key]];
    const missing = (x === null || x === undefined) - (y === null || y === undefined);
    if (missing) return missing;
    return (x > y ? down : x < y ? -down : 0) * 1;
  };
  lines.sort(order).forEach((line) => table.tBodies[0].appendChild(line));
}
const quote = (text) => `'${text.replace(/'/g, "'\\''")}'`;
function choose() {
  const picked = lines.filter((line) => box(line).checked), section = document.getElementById("chosen");
  lines.forEach((line) => line.classList.toggle("chosen", box(line).checked));
  section.replaceChildren();
  section.hidden = picked.length < 1 || picked.length > 2;
  if (picked.length === 1) showNote(section, rowOf(picked[0]));
  if (picked.length === 2) showPair(section, picked.map(rowOf));
  drawTrend();
}
function showNote(section, row) {
  add(section, "h2", {}, `Note on ${row.folder}`);
  const isServed = "served" in document.body.dataset;
  add(section, "p", { class: "note" }, isServed ? "Save writes notes.toml next to the recording, which stays as it is."
    : "A page that is a file cannot write; that of shaketwin runs --serve does. This command does too, into notes.toml next to the recording, which stays as it is; then list the runs again.");
  const controls = add(section, "div", { class: "controls" });
  const note = add(controls, "input", { "aria-label": "Note", placeholder: "note", size: 40 }), tags = add(controls, "input", { "aria-label": "Tags", placeholder: "tags, separated by commas" });
  note.value = row.note || "";
  tags.value = (row.tags || []).join(", ");
  const command = add(section, isServed ? "p" : "pre", { role: "status" });
  const change = () => {
    const wanted = tags.value.split(",").map((tag) => tag.trim()).filter(Boolean), had = row.tags || [];
    return { folder: row.folder, before: row.note || "", note: note.value,
      tags: wanted.filter((tag) => !had.includes(tag)), untag: had.filter((tag) => !wanted.includes(tag)) };
  };
  if (isServed) {
    const button = add(controls, "button", { type: "button" }, "Save");
    button.addEventListener("click", () => save(row, change(), command));
    return;
  }
  const update = () => {
    const { tags: more, untag } = change();
    const words = [...more.map((tag) => `--tag ${quote(tag)}`), ...untag.map((tag) => `--untag ${quote(tag)}`)];
    command.textContent = ["shaketwin note", quote(row.path), ...(note.value !== (row.note || "") ? [quote(note.value)] : []), ...words].join(" ");
  };
  [note, tags].forEach((field) => field.addEventListener("input", update));
  update();
}
async function save(row, change, status) {
  const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(change) };
  const answer = await fetch("note", options).catch(() => null);
  if (!answer?.ok) {
    status.textContent = `Not saved: ${answer ? await answer.text() : "the server has ended"}`;
    return;
  }
  Object.assign(row, await answer.json());
  const cell = lines.find((line) => rowOf(line) === row).querySelector(".remark");
  cell.replaceChildren();
  row.tags.forEach((tag) => add(cell, "span", { class: "tag" }, tag));
  cell.append(row.note);
  status.textContent = "Saved.";
}
function showPair(section, pair) {
  add(section, "h2", {}, "Two runs");
  add(section, "p", { class: "note" }, "What differs; the whole comparison, with curves:");
  add(section, "pre", {}, `shaketwin compare ${pair.map((row) => quote(row.path)).join(" ")}`);
  const grid = add(add(section, "div", { class: "wide" }), "table"), keys = [...new Set(pair.flatMap(Object.keys))];
  const heads = add(add(grid, "thead"), "tr"), body = add(grid, "tbody");
  ["", pair[0].folder, pair[1].folder, "change"].forEach((text) => add(heads, "th", { class: "text" }, text));
  for (const key of keys) {
    const [a, b] = pair.map((row) => row[key]);
    if (show(a) === show(b) || ["path", "files", "folder", "run", "twin_misfit", "twin_misfit_worst"].includes(key) || key.endsWith("sha256")) continue;
    const line = add(body, "tr"), both = typeof a === "number" && typeof b === "number";
    add(line, "td", { class: "text" }, key);
    [show(a), show(b), both ? `${show(b - a)}${a ? ` (${Number(((100 * (b - a)) / Math.abs(a)).toPrecision(3))} %)` : ""}` : ""].forEach((text) => add(line, "td", { class: "text long" }, text));
  }
}
function drawTrend() {
  const key = quantity.value, width = svg.clientWidth || 800, height = svg.clientHeight || 270;
  const points = lines.filter((line) => !line.hidden).map((line) => ({ line, row: rowOf(line), t: Date.parse(rowOf(line).started_at), y: rowOf(line)[key] }))
    .filter((point) => Number.isFinite(point.t) && typeof point.y === "number");
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  if (!points.length) return add(svg, "text", { x: 10, y: 30 }, "no values");
  const ends = (point) => [point.row[`${key}_low`] ?? point.y, point.row[`${key}_high`] ?? point.y];
  const values = points.flatMap(ends), times = points.map((point) => point.t);
  const spread = (list) => { const low = Math.min(...list), high = Math.max(...list), pad = (high - low || Math.abs(high) || 1) * 0.06; return [low - pad, high + pad]; };
  const [y0, y1] = spread(values), [t0, t1] = spread(times), left = 84, bottom = height - 26;
  const x = (t) => left + ((t - t0) / (t1 - t0)) * (width - left - 16), y = (v) => bottom - ((v - y0) / (y1 - y0)) * (bottom - 10);
  for (let k = 0; k <= 4; k += 1) {
    const value = y0 + (k / 4) * (y1 - y0);
    add(svg, "line", { class: "axis", x1: left, x2: width - 16, y1: y(value), y2: y(value) });
    add(svg, "text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, Number(value.toPrecision(4)).toString());
  }
  for (const t of new Set([Math.min(...times), Math.max(...times)])) {
    const anchor = times.length > 1 && t === Math.max(...times) ? "end" : "start";
    add(svg, "text", { x: x(t), y: height - 6, "text-anchor": anchor }, new Date(t).toISOString().slice(0, 10));
  }
  for (const point of points) {
    const [low, high] = ends(point);
    if (high > low) add(svg, "line", { class: "bar", x1: x(point.t), x2: x(point.t), y1: y(low), y2: y(high) });
    const dot = add(svg, "circle", { cx: x(point.t), cy: y(point.y), r: 4, class: box(point.line).checked ? "chosen" : "" });
    add(dot, "title", {}, `${point.row.folder}: ${show(point.y)}`);
    dot.addEventListener("click", () => { box(point.line).checked = !box(point.line).checked; choose(); });
  }
}
const first = ["stiffness", "damping", "gap_r", "gap_l", "misfit"];
const numeric = [...new Set(rows.flatMap(Object.keys))].filter((key) => !/_(low|high)$/.test(key) && rows.some((row) => typeof row[key] === "number"));
for (const key of [...first.filter((name) => numeric.includes(name)), ...numeric.filter((name) => !first.includes(name))]) add(quantity, "option", {}, key);
document.getElementById("filter").addEventListener("input", filter);
table.tHead.addEventListener("click", (event) => { const head = event.target.closest("th[data-key]"); if (head) sortBy(head); });
table.tBodies[0].addEventListener("change", choose);
quantity.addEventListener("change", drawTrend);
window.addEventListener("resize", drawTrend);
drawTrend();
