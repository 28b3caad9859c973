"use strict";
// Draws the branches of the embedded data as SVG, with zoom, hover and a phase portrait.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const chart = byId("chart"), portrait = byId("portrait"), readout = byId("readout");
const SVG = "http://www.w3.org/2000/svg", MARGIN = { left: 58, right: 14, top: 12, bottom: 40 };
const MAX_DISTANCE_PX = 30; // from the pointer to the nearest point that is shown
let quantity = data.quantities[0], view = null;

function add(parent, name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  parent.appendChild(node);
  return node;
}

function range(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value === null) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low <= high ? [low, high] : [0, 1];
}

function fullView() {
  const lists = [...data.branches, ...data.measured];
  const [x0, x1] = range([...lists.flatMap((b) => b.x), ...data.bands.flat()]);
  const [, y1] = range(lists.flatMap((b) => b.values[quantity.key] || []));
  const dx = (x1 - x0 || 1) * 0.02;
  return { x0: x0 - dx, x1: x1 + dx, y0: 0, y1: y1 * 1.06 || 1 };
}

function ticks(low, high, count) {
  const raw = (high - low) / count, base = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * base).find((s) => s >= raw);
  const result = [];
  for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k += 1) result.push(k * step);
  return result.map((value) => [value, value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))]);
}

function scales(box, limits) {
  const width = box.clientWidth, height = box.clientHeight;
  const w = width - MARGIN.left - MARGIN.right, h = height - MARGIN.top - MARGIN.bottom;
  return {
    width, height, w, h,
    x: (value) => MARGIN.left + ((value - limits.x0) / (limits.x1 - limits.x0)) * w,
    y: (value) => MARGIN.top + h - ((value - limits.y0) / (limits.y1 - limits.y0)) * h,
    toX: (px) => limits.x0 + ((px - MARGIN.left) / w) * (limits.x1 - limits.x0),
    toY: (px) => limits.y0 + ((MARGIN.top + h - px) / h) * (limits.y1 - limits.y0),
  };
}

function drawFrame(box, s, limits, labels, name) {
  box.replaceChildren();
  box.setAttribute("viewBox", `0 0 ${s.width} ${s.height}`);
  const clip = add(add(box, "defs", {}), "clipPath", { id: name });
  add(clip, "rect", { x: MARGIN.left, y: MARGIN.top, width: s.w, height: s.h });
  for (const [value, text] of ticks(limits.x0, limits.x1, s.w / 80)) {
    add(box, "line", { class: "grid", x1: s.x(value), x2: s.x(value), y1: MARGIN.top, y2: MARGIN.top + s.h });
    add(box, "text", { x: s.x(value), y: s.height - 22, "text-anchor": "middle" }, text);
  }
  for (const [value, text] of ticks(limits.y0, limits.y1, s.h / 45)) {
    add(box, "line", { class: "grid", x1: MARGIN.left, x2: MARGIN.left + s.w, y1: s.y(value), y2: s.y(value) });
    add(box, "text", { x: MARGIN.left - 6, y: s.y(value) + 4, "text-anchor": "end" }, text);
  }
  add(box, "rect", { class: "frame", x: MARGIN.left, y: MARGIN.top, width: s.w, height: s.h });
  add(box, "text", { x: MARGIN.left + s.w / 2, y: s.height - 5, "text-anchor": "middle" }, labels[0]);
  add(box, "text", { x: 0, y: 0, "text-anchor": "middle", transform: `translate(13 ${MARGIN.top + s.h / 2}) rotate(-90)` }, labels[1]);
  return add(box, "g", { "clip-path": `url(#${name})` });
}

function draw() {
  view = view || fullView();
  const s = scales(chart, view), area = drawFrame(chart, s, view, [data.parameter.label, quantity.label], "area");
  if (byId("bands").checked) {
    for (const [from, to] of data.bands) {
      add(area, "rect", { class: "band", x: s.x(from), y: MARGIN.top, width: Math.max(1, s.x(to) - s.x(from)), height: s.h });
    }
  }
  for (const series of data.measured) {
    series.x.forEach((x, i) => add(area, "circle", { class: "measured", cx: s.x(x), cy: s.y(series.values[quantity.key][i]), r: 4, fill: series.colour }));
  }
  for (const branch of data.branches) {
    const values = branch.values[quantity.key];
    for (let i = 0; i + 1 < values.length; ) {
      let path = `M${s.x(branch.x[i])} ${s.y(values[i])}`;
      const stable = branch.stable[i] && branch.stable[i + 1];
      let j = i;
      while (j + 1 < values.length && (branch.stable[j] && branch.stable[j + 1]) === stable) {
        j += 1;
        path += `L${s.x(branch.x[j])} ${s.y(values[j])}`;
      }
      add(area, "path", { class: stable ? "branch" : "branch unstable", d: path, stroke: branch.colour });
      i = j;
    }
  }
  if (byId("marks").checked) {
    for (const mark of data.bifurcations) {
      const node = add(area, "circle", { class: "mark", cx: s.x(mark.x), cy: s.y(mark.values[quantity.key]), r: 5, fill: mark.colour });
      add(node, "title", {}, mark.text);
    }
  }
  add(area, "circle", { class: "cursor", id: "cursor", r: 6, cx: -99, cy: -99 });
}

function show(event) {
  const box = chart.getBoundingClientRect(), s = scales(chart, view);
  const px = event.clientX - box.left, py = event.clientY - box.top;
  let best = null, nearest = MAX_DISTANCE_PX;
  for (const branch of data.branches) {
    branch.x.forEach((x, i) => {
      const distance = Math.hypot(s.x(x) - px, s.y(branch.values[quantity.key][i]) - py);
      if (distance < nearest) [nearest, best] = [distance, [branch, i]];
    });
  }
  if (!best) return;
  const [branch, i] = best;
  byId("cursor").setAttribute("cx", s.x(branch.x[i]));
  byId("cursor").setAttribute("cy", s.y(branch.values[quantity.key][i]));
  readout.textContent = [
    `${data.parameter.label}: ${branch.x[i]}`,
    ...data.quantities.map((q) => `${q.label}: ${branch.values[q.key][i]}`),
    `${branch.stable[i] ? "stable" : "unstable"}, period ${branch.period}`,
    `multipliers: ${branch.multipliers[i].join(", ")}`,
    `impacts right / left: ${branch.impacts[i].join(" / ")}`,
  ].join("\n");
  drawPortrait(branch, i);
}

function drawPortrait(branch, i) {
  const [u, v] = branch.orbits[i], [x0, x1] = range(u), [y0, y1] = range(v);
  const dx = (x1 - x0) * 0.08 || 1, dy = (y1 - y0) * 0.08 || 1;
  const limits = { x0: x0 - dx, x1: x1 + dx, y0: y0 - dy, y1: y1 + dy };
  const s = scales(portrait, limits), area = drawFrame(portrait, s, limits, ["u in mm", "u' in mm/s"], "orbit");
  for (const wall of branch.walls[i]) {
    add(area, "line", { x1: s.x(wall), x2: s.x(wall), y1: MARGIN.top, y2: MARGIN.top + s.h, stroke: "#555", "stroke-dasharray": "5 3" });
  }
  const path = u.map((x, k) => `${k ? "L" : "M"}${s.x(x)} ${s.y(v[k])}`).join("") + "Z";
  add(area, "path", { class: branch.stable[i] ? "branch" : "branch unstable", d: path, fill: "none", stroke: branch.colour, "stroke-width": 1.6 });
}

for (const option of data.quantities) byId("quantity").add(new Option(option.label, option.key));
byId("quantity").addEventListener("change", (event) => {
  quantity = data.quantities.find((q) => q.key === event.target.value);
  view = null;
  draw();
});
for (const id of ["marks", "bands"]) byId(id).addEventListener("change", draw);
const reset = () => { view = null; draw(); };
byId("reset").addEventListener("click", reset);
chart.addEventListener("dblclick", reset);
chart.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = chart.getBoundingClientRect(), s = scales(chart, view), factor = event.deltaY > 0 ? 1.2 : 1 / 1.2;
  const cx = s.toX(event.clientX - box.left), cy = s.toY(event.clientY - box.top);
  view = {
    x0: cx - (cx - view.x0) * factor, x1: cx + (view.x1 - cx) * factor,
    y0: cy - (cy - view.y0) * factor, y1: cy + (view.y1 - cy) * factor,
  };
  draw();
}, { passive: false });
let drag = null;
chart.addEventListener("pointerdown", (event) => { drag = { x: event.clientX, y: event.clientY, view: { ...view } }; });
addEventListener("pointerup", () => { drag = null; });
chart.addEventListener("pointermove", (event) => {
  if (!drag) { show(event); return; }
  const s = scales(chart, drag.view);
  const dx = ((event.clientX - drag.x) / s.w) * (drag.view.x1 - drag.view.x0);
  const dy = ((event.clientY - drag.y) / s.h) * (drag.view.y1 - drag.view.y0);
  view = { x0: drag.view.x0 - dx, x1: drag.view.x1 - dx, y0: drag.view.y0 + dy, y1: drag.view.y1 + dy };
  draw();
});
addEventListener("resize", draw);
byId("legend").textContent = data.legend;
draw();
