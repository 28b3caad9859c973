"use strict";
// Draws the figures of CHARTS into the elements of their names, with uPlot: axes, scales and zoom
// are its own; the marks of a panel and what the pointer is at are drawn here.
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)"), charts = [];
  let printing = false;
  const isDark = () => dark.matches && !printing;
  const ink = () => (isDark() ? "#c8ccd2" : "#333a42"), grid = () => (isDark() ? "#2b3138" : "#e6e9ec");
  const columns = CHARTS.columns.map((column) => {
    if (Array.isArray(column)) return column.map((v) => (v === null ? NaN : v));
    const bytes = Uint8Array.from(atob(column.codes), (c) => c.charCodeAt(0));
    const codes = new Uint16Array(bytes.buffer);
    return Float64Array.from(codes, (v) => (v === 65535 ? NaN : column.low + v * column.step));
  });
  // A dark line is lightened on a dark ground.
  function colourOf(colour) {
    if (colour === "white") return isDark() ? "#14171c" : "#fff";
    if (!isDark() || !/^#[0-9a-f]{6}$/i.test(colour)) return colour;
    const parts = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    const light = (0.3 * parts[0] + 0.59 * parts[1] + 0.11 * parts[2]) / 255;
    const share = Math.max(0, 0.75 - light);
    return `rgb(${parts.map((v) => Math.round(v + (255 - v) * share)).join(" ")})`;
  }
  const format = (v) => (v === 0 ? "0" : String(+v.toPrecision(6)).replace("-", "−"));
  const short = (v) => format(+v.toPrecision(4));
  function splitLogarithmic(u, axis, low, high) {
    const digits = high / low < 1000 ? [1, 2, 5] : [1], ticks = [];
    for (let p = Math.floor(Math.log10(low)); p <= Math.log10(high); p++)
      for (const d of digits) ticks.push(d * 10 ** p);
    return ticks.filter((v) => v >= low && v <= high);
  }
  function drawMarker(c, mark, x, y, scale) {
    const r = (mark.size * 0.62 + 0.4) * scale;
    const path = new Path2D();
    switch (mark.marker) {
      case "s": path.rect(x - r, y - r, 2 * r, 2 * r); break;
      case "D": path.moveTo(x, y - r * 1.3); path.lineTo(x + r * 1.3, y); path.lineTo(x, y + r * 1.3); path.lineTo(x - r * 1.3, y); path.closePath(); break;
      case "^": path.moveTo(x, y - r * 1.2); path.lineTo(x + r * 1.1, y + r); path.lineTo(x - r * 1.1, y + r); path.closePath(); break;
      case "x": path.moveTo(x - r, y - r); path.lineTo(x + r, y + r); path.moveTo(x + r, y - r); path.lineTo(x - r, y + r); break;
      case "_": path.moveTo(x - r * 1.4, y); path.lineTo(x + r * 1.4, y); break;
      case "*": for (let i = 0; i < 10; i++) { const a = (i * Math.PI) / 5 - Math.PI / 2, q = i % 2 ? r * 0.45 : r * 1.15; path.lineTo(x + q * Math.cos(a), y + q * Math.sin(a)); } path.closePath(); break;
      default: path.arc(x, y, r, 0, 2 * Math.PI);
    }
    if (mark.face && mark.face !== "none" && !"x_".includes(mark.marker)) { c.fillStyle = colourOf(mark.face); c.fill(path); }
    if (mark.edge !== "none") { c.strokeStyle = colourOf(mark.edge || mark.colour); c.lineWidth = 1.1 * scale; c.stroke(path); }
  }
  function drawMark(u, c, mark, scale) {
    const X = (v) => u.valToPos(v, "x", true), Y = (v) => u.valToPos(v, "y", true);
    const box = u.bbox, colour = mark.kind.endsWith("span") ? mark.colour : colourOf(mark.colour);
    c.globalAlpha = mark.alpha; c.strokeStyle = colour; c.fillStyle = colour;
    c.lineWidth = mark.width * 1.25 * scale;
    c.setLineDash(mark.dash.map((v) => v * mark.width * 1.25 * scale));
    const x = columns[mark.x], y = columns[mark.y], z = columns[mark.z];
    switch (mark.kind) {
      case "line":
        if (mark.line) {
          c.beginPath();
          for (let i = 0, pen = false; i < x.length; i++) {
            const px = X(x[i]), py = Y(y[i]);
            if (!isFinite(px) || !isFinite(py)) { pen = false; continue; }
            pen ? c.lineTo(px, py) : c.moveTo(px, py); pen = true;
          }
          c.stroke();
        }
        c.setLineDash([]);
        if (mark.marker) for (let i = 0; i < x.length; i++)
          if (isFinite(y[i])) drawMarker(c, mark, X(x[i]), Y(y[i]), scale);
        break;
      case "fill":
        c.beginPath();
        for (let i = 0; i < x.length; i++) c.lineTo(X(x[i]), Y(z[i]));
        for (let i = x.length - 1; i >= 0; i--) c.lineTo(X(x[i]), Y(y[i]));
        c.fill(); break;
      case "bars":
        for (let i = 0; i < x.length; i++) { c.beginPath(); c.moveTo(X(x[i]), Y(y[i])); c.lineTo(X(x[i]), Y(z[i])); c.stroke();
          if (mark.marker) drawMarker(c, mark, X(x[i]), Y((y[i] + z[i]) / 2), scale); }
        break;
      case "hline": c.beginPath(); c.moveTo(box.left, Y(mark.at)); c.lineTo(box.left + box.width, Y(mark.at)); c.stroke(); break;
      case "vline": c.beginPath(); c.moveTo(X(mark.at), box.top); c.lineTo(X(mark.at), box.top + box.height); c.stroke(); break;
      case "hspan": { const [a, b] = mark.at.map(Y); c.fillRect(box.left, Math.min(a, b), box.width, Math.abs(a - b)); break; }
      case "vspan": { const [a, b] = mark.at.map(X); c.fillRect(Math.min(a, b), box.top, Math.abs(a - b), box.height); break; }
      case "arrow": {
        const [x0, y0, x1, y1] = [X(mark.at[0]), Y(mark.at[1]), X(mark.at[2]), Y(mark.at[3])];
        const a = Math.atan2(y1 - y0, x1 - x0), h = 7 * scale;
        c.lineWidth = 1.8 * scale; c.beginPath(); c.moveTo(x0, y0); c.lineTo(x1, y1); c.stroke();
        c.beginPath(); c.moveTo(x1, y1);
        for (const d of [2.7, -2.7]) c.lineTo(x1 + h * Math.cos(a + d), y1 + h * Math.sin(a + d));
        c.fill(); break;
      }
      case "text": {
        const px = mark.inside[0] ? box.left + mark.at[0] * box.width : X(mark.at[0]);
        const py = mark.inside[1] ? box.top + (1 - mark.at[1]) * box.height : Y(mark.at[1]);
        c.globalAlpha = 1; c.fillStyle = mark.colour === "#111111" ? ink() : colour; c.font = `${12 * scale}px system-ui, sans-serif`;
        c.textAlign = mark.ha; c.textBaseline = { top: "top", center: "middle", bottom: "bottom" }[mark.va] || "bottom";
        c.fillText(mark.text, px + mark.shift * scale, py);
      }
    }
  }
  function drawPanel(u, panel, isBackground) {
    const c = u.ctx, scale = devicePixelRatio;
    c.save();
    for (const mark of panel.marks) {
      if (isBackground !== mark.kind.endsWith("span")) continue;
      c.save();
      if (mark.kind !== "text") { c.beginPath(); c.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height); c.clip(); }
      drawMark(u, c, isBackground && isDark() ? { ...mark, alpha: mark.alpha * (mark.alpha < 1 ? 1 : 0.3) } : mark, scale);
      c.restore();
    }
    c.restore();
  }
  function findNearest(u, panel) {
    let best = null, limit = 24 ** 2;
    for (const mark of panel.marks) {
      if (mark.kind !== "line") continue;
      const x = columns[mark.x], y = columns[mark.y];
      for (let i = 0; i < x.length; i++) {
        const px = u.valToPos(x[i], "x"), py = u.valToPos(y[i], "y");
        const distance = (px - u.cursor.left) ** 2 + (py - u.cursor.top) ** 2;
        if (distance < limit) { limit = distance; best = { mark, x: x[i], y: y[i], px, py }; }
      }
    }
    return best;
  }
  function showValue(u, panel, tip) {
    const near = u.cursor.left >= 0 ? findNearest(u, panel) : null;
    tip.hidden = !near;
    if (!near) return;
    tip.innerHTML = `${near.mark.label ? near.mark.label + "<br>" : ""}${short(near.x)}, <b>${short(panel.absolute ? Math.abs(near.y) : near.y)}</b>`;
    tip.style.left = `${Math.min(near.px + 10, u.over.clientWidth - tip.offsetWidth)}px`;
    tip.style.top = `${Math.max(0, near.py - tip.offsetHeight - 8)}px`;
  }
  function addPanel(host, panel, group, rowLabel) {
    host.innerHTML = `<div class="label">${panel.title ? `<b>${panel.title}</b> ` : ""}${panel.ylabel || `<span class="narrow">${rowLabel}</span>`}</div>`;
    if (panel.keys.length) host.append(makeKeys(panel.keys));
    const axis = (n) => ({
      stroke: ink, font: "12px system-ui, sans-serif", grid: { stroke: grid, width: 1 }, ticks: { show: false },
      values: (u, ticks) => ticks.map((v) => (v === null ? "" : format(n && panel.absolute ? Math.abs(v) : v))),
      ...(panel.log[n] ? { splits: splitLogarithmic, filter: (u, ticks) => ticks } : {}),
    });
    const plain = new DOMParser().parseFromString(panel.xlabel, "text/html").body.textContent;
    const tip = Object.assign(document.createElement("div"), { className: "tip", hidden: true });
    const u = new uPlot({
      width: host.clientWidth, height: panel.height, legend: { show: false }, pxAlign: false, padding: [8, 8, 0, 0],
      cursor: { points: { show: false }, drag: { x: true, y: true, uni: 12 },
        bind: { dblclick: () => () => { for (const other of group ? group.panels : [u]) goHome(other); } } },
      scales: { x: { time: false, distr: panel.log[0] ? 3 : 1, range: (u, min, max) => [min, max] }, y: { distr: panel.log[1] ? 3 : 1, range: () => panel.y } },
      series: [{}, { show: true, paths: () => null, points: { show: false } }],
      axes: [{ ...axis(0), size: 26, label: plain || undefined, labelSize: 20, labelFont: "12px system-ui, sans-serif", labelGap: 0 }, { ...axis(1), size: 56, space: 24 }],
      hooks: {
        drawClear: [(u) => drawPanel(u, panel, true)], draw: [(u) => drawPanel(u, panel, false)],
        setCursor: [(u) => showValue(u, panel, tip)],
        setScale: [(u, key) => { if (key === "x" && group && !group.busy) followZoom(u, group); }],
      },
    }, [panel.x, panel.y], host);
    const goHome = (other) => other.batch(() => { other.setScale("x", toRange(other.home.x)); other.setScale("y", toRange(other.home.y)); });
    u.home = panel;
    u.over.append(tip);
    if (group) group.panels.push(u);
    charts.push({ u, host });
    new ResizeObserver(() => { if (host.clientWidth && !printing) u.setSize({ width: host.clientWidth, height: panel.height }); }).observe(host);
  }
  const toRange = ([min, max]) => ({ min, max });
  function followZoom(u, group) {
    group.busy = true;
    for (const other of group.panels)
      if (other !== u) other.batch(() => other.setScale("x", { min: u.scales.x.min, max: u.scales.x.max }));
    group.busy = false;
  }
  function makeKeys(keys) {
    const list = Object.assign(document.createElement("div"), { className: "keys" });
    for (const key of keys) {
      const canvas = document.createElement("canvas"), entry = document.createElement("span");
      canvas.width = 56; canvas.height = 28; canvas.style.width = "28px"; canvas.style.height = "14px";
      entry.append(canvas); entry.insertAdjacentHTML("beforeend", key.label); list.append(entry);
      const draw = () => {
        const c = canvas.getContext("2d"), colour = colourOf(key.colour);
        c.clearRect(0, 0, 56, 28); c.globalAlpha = key.patch && isDark() && key.alpha === 1 ? 0.3 : key.alpha; c.fillStyle = c.strokeStyle = colour;
        if (key.patch) { c.fillRect(8, 4, 40, 20); return; }
        c.lineWidth = key.width * 2.5; c.setLineDash(key.dash.map((v) => v * key.width * 2.5));
        if (key.line) { c.beginPath(); c.moveTo(2, 14); c.lineTo(54, 14); c.stroke(); }
        c.setLineDash([]);
        if (key.marker) drawMarker(c, key, 28, 14, 2);
      };
      draw(); charts.push({ redraw: draw });
    }
    return list;
  }
  for (const figure of CHARTS.figures) {
    const place = document.querySelector(`#${CSS.escape(figure.name)} .chart`), groups = {};
    if (!place) continue;
    if (figure.keys.length) place.append(makeKeys(figure.keys));
    for (const row of figure.rows) {
      const line = Object.assign(document.createElement("div"), { className: "panels" });
      line.style.gridTemplateColumns = row.map((panel) => `minmax(0,${panel.width}fr)`).join(" ");
      place.append(line);
      for (const panel of row) {
        const host = document.createElement("div");
        line.append(host);
        const group = panel.link === undefined ? null : (groups[panel.link] ??= { panels: [], busy: false });
        addPanel(host, panel, group, row[0].ylabel);
      }
    }
  }
  const redraw = () => { for (const { u, redraw } of charts) u ? u.batch(() => u.redraw(false, true)) : redraw(); };
  dark.addEventListener("change", redraw);
  // Paper gets a picture of each panel as it is, on a light ground.
  addEventListener("beforeprint", () => {
    printing = true; redraw();
    for (const { u, host } of charts) if (u) host.append(Object.assign(new Image(), { className: "paper", src: u.ctx.canvas.toDataURL() }));
  });
  addEventListener("afterprint", () => {
    printing = false; redraw();
    document.querySelectorAll("img.paper").forEach((image) => image.remove());
  });
})();
