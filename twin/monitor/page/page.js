"use strict";
// Page of a running test. Sections arrive as server-sent events, read with fetch so that the access code is sent in a
// header: it is in no address, no cookie and no log. Text is set as text, never as markup.

const $ = (id) => document.getElementById(id);
const state = {}; // newest section by name
const retryMs = 1000;
let silenceMs = 6000, answerMs = 8000, lastMessage = 0, dirty = true, code = takeCode();

function takeCode() {
  const fresh = decodeURIComponent(location.hash.slice(1));
  if (fresh) {
    sessionStorage.setItem("code", fresh);
    history.replaceState(null, "", location.pathname);
  }
  return fresh || sessionStorage.getItem("code") || "";
}

// A keyboard that writes a dash for a hyphen: a header takes no such character, and the code needs neither.
const headers = () => (code ? { Authorization: `Bearer ${code.replace(/\W/g, "")}` } : {});

async function listen() {
  for (;;) {
    try {
      const response = await fetch("events", { headers: headers() });
      if (response.status === 401) await askCode((await response.json()).message);
      else if (response.ok) await readEvents(response.body.getReader());
      else $("answer").textContent = (await response.json()).message;
    } catch { /* the server is away: try again */ }
    await new Promise((done) => setTimeout(done, retryMs));
  }
}

async function readEvents(reader) {
  const decoder = new TextDecoder();
  for (let text = ""; ;) {
    const timeout = setTimeout(() => reader.cancel(), silenceMs);
    const { value, done } = await reader.read().finally(() => clearTimeout(timeout));
    if (done) return;
    lastMessage = Date.now();
    const messages = (text + decoder.decode(value, { stream: true })).split("\n\n");
    text = messages.pop();
    for (const message of messages) {
      const match = /^event: (.*)\ndata: (.*)$/.exec(message);
      if (match) state[match[1]] = JSON.parse(match[2]);
    }
    dirty = true;
  }
}

function askCode(refusal) {
  $("login").hidden = false;
  $("refusal").textContent = code ? refusal : "";
  return new Promise((done) => {
    $("login").onsubmit = (event) => {
      event.preventDefault();
      code = $("code").value;
      sessionStorage.setItem("code", code);
      $("code").value = "";
      $("login").hidden = true;
      done();
    };
  });
}

async function send(command) {
  $("answer").className = "";
  $("answer").textContent = `${command} …`;
  const request = { method: "POST", headers: { ...headers(), "Content-Type": "application/json" },
    body: JSON.stringify({ command, run: state.run.run }), signal: AbortSignal.timeout(answerMs) };
  try {
    const response = await fetch("command", request);
    $("answer").className = response.ok ? "good" : "bad";
    $("answer").textContent = (await response.json()).message;
  } catch {
    $("answer").className = "bad";
    $("answer").textContent = `no answer to ${command}: use the machine's own stop`;
  }
}

for (const button of document.querySelectorAll("[data-command]"))
  button.onclick = () => {
    $("question").textContent = `${button.dataset.command} the test?`;
    $("commands").hidden = true;
    $("confirm").hidden = false;
    $("yes").onclick = () => { closeQuestion(); send(button.dataset.command); };
  };
$("no").onclick = closeQuestion;
function closeQuestion() { $("confirm").hidden = true; $("commands").hidden = false; dirty = true; }

// Numbers and text

const known = (value) => value !== null && value !== undefined;
const digits = (value, count = 3) => !known(value) ? "–" : value && Math.abs(value) < 1e-3 ? minus(value.toExponential(1))
  : minus(Number(value.toPrecision(count)));
const minus = (value) => String(value).replaceAll("-", "−");
const signed = (value, unit) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(1)} ${unit}`;
function duration(seconds) {
  const whole = Math.max(Math.floor(seconds), 0), two = (n) => String(n).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
}
function element(tag, className, ...children) {
  const node = document.createElement(tag);
  node.className = className;
  node.append(...children);
  return node;
}

// By the last section that each needs: a slow network delivers the sections one by one.
const drawings = { state: drawHeader, level: drawLevel, trace: drawTraces, prc: drawPrc, events: drawEvents,
  margins: drawMargins, twin: drawTwin, timing: drawTiming, user: drawUser };

function draw() {
  requestAnimationFrame(() => setTimeout(draw, 100)); // first: an error below does not end the drawing
  const stale = Date.now() - lastMessage > silenceMs;
  if (stale !== document.body.classList.contains("stale")) dirty = true;
  if (dirty && state.state) {
    dirty = false;
    document.body.classList.toggle("stale", stale);
    for (const [section, drawSection] of Object.entries(drawings)) if (state[section]) drawSection(stale);
  } else if (stale && !state.state && lastMessage) setState("page disconnected", "bad");
}

function setState(text, tone) {
  $("state").textContent = text;
  $("state").className = `badge ${tone}`;
}

function drawHeader(stale) {
  const run = state.run, s = state.state;
  $("name").textContent = run.title || run.name || "shaketwin";
  $("rig").textContent = [run.rig, run.run].filter(Boolean).join(" · ");
  document.title = `${s.state} · ${run.name || "shaketwin"}`;
  stale ? setState("page disconnected", "bad") : setState(s.state, s.tone);
  $("activity").textContent = s.ended ? s.reason : s.activity;
  $("step").textContent = s.windows !== null ? (s.window ? `window ${s.window}/${s.windows}` : "outside the history")
    : s.step === null ? (s.ended ? "test over" : "no step in progress")
    : `step ${s.step}/${s.steps} · ${digits(s.frequency_hz, 4)} Hz ${s.direction === "forward" ? "↑" : "↓"} ${s.direction}`
      + (s.cycle ? ` · cycle ${s.cycle}${s.cycles ? "/" + s.cycles : ""}` : "");
  const left = s.ended || s.left_s === null ? "" : s.held ? "held until resumed"
    : `${duration(Math.abs(s.left_s))} ${s.left_s < 0 ? "over" : "left"}`;
  $("left").textContent = [duration(s.time_s), left].filter(Boolean).join(", ");
  $("progress").hidden = s.progress === null;
  $("progress").firstChild.style.width = `${100 * (s.progress || 0)}%`;
}

function drawLevel() {
  const l = state.level, has = known(l.demanded_g);
  $("level").textContent = has && known(l.current_g) ? `${l.current_g.toFixed(4)} g` : "–";
  const share = known(l.deviation) ? l.deviation : null;
  $("deviation").textContent = share === null ? (has ? "not steady yet" : "no step in progress") : signed(100 * share, "%");
  $("deviation").className = share === null ? "dim" : l.tone;
  $("level-note").textContent = !has ? "" : `demanded ${l.demanded_g.toFixed(4)} g`
    + (known(l.peak_g) ? `, peak ${l.peak_g.toFixed(4)} g` : "")
    + (known(l.accepted) ? `, ${l.accepted ? "accepted" : "being tuned"}, corrected ${l.updates} ×` : "");
  drawLevelScale(has ? l : null, share);
}

function drawMargins() {
  $("margins").replaceChildren(...state.margins.rows.map((row) => {
    const { tone } = row;
    const fill = element("i", "");
    fill.style.width = `${100 * Math.min(row.share ?? 0, 1)}%`;
    return element("div", "margin", element("span", "", row.name), element("span", `bar ${tone}`, fill),
      element("span", "dim", `${row.peak === null ? "lost" : digits(row.peak)} / ${digits(row.limit)} ${row.unit}`),
      element("span", tone, row.share === null ? "–" : `${Math.round(100 * row.share)} %`));
  }));
}

function drawEvents() {
  $("events").replaceChildren(...state.events.rows.map((event) => element("li", { WARN: "warn", ERROR: "bad" }[event.level] || "",
    element("span", "dim", duration(event.time_s)), element("span", "", event.text))));
}

function drawTable(id, rows) {
  $(id).replaceChildren(...rows.map((cells) => element("tr", "", ...cells.map(([text, tone]) => element("td", tone || "", String(text))))));
}

function drawTwin() {
  drawTable("twin", state.twin.rows.map((row) => [[row.name], [digits(row.rms)], [digits(row.error), row.exceeds ? "bad" : ""],
    [digits(row.band), "dim"], [row.unit, "dim"]]));
}

function drawTiming() {
  drawTable("timing", state.timing.rows.map((row) => [[row.component], [digits(row.p50_ms)], [digits(row.p99_ms)], [digits(row.max_ms)],
    [row.missed, row.missed ? "warn" : ""]]));
  const { dropouts, components } = state.state;
  $("dropouts").textContent = `${dropouts} dropouts; connected: ${components.join(", ") || "none"}`;
  $("dropouts").className = dropouts ? "bad" : "dim";
}

function drawUser() {
  const user = state.user, asking = !$("confirm").hidden;
  $("user").textContent = user ? `${user.name}${user.role ? ", role " + user.role : ""}` : "";
  $("commands").hidden = asking || !user || user.role !== "command" || state.state.ended || !state.run.run;
}

// Plots

function prepare(id) {
  const canvas = $(id), scale = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = `12px ${getComputedStyle(document.body).fontFamily}`;
  return { context, width, height, colour: (name) => style.getPropertyValue(`--${name}`).trim() };
}

function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw * 0.999), list = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) list.push(Number((k * step).toPrecision(6)));
  return list;
}

/** The end of an axis, which changes rarely while a peak grows. */
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((k) => k * power).find((end) => end >= value);
}

/** Draw axes; return functions that draw in the units of the axes. */
function plot(id, x, y, title) {
  const p = prepare(id), c = p.context, box = { left: 46, right: p.width - 10, top: 20, bottom: p.height - 20 };
  const px = (v) => box.left + ((v - x[0]) / (x[1] - x[0] || 1)) * (box.right - box.left);
  const py = (v) => box.bottom - ((v - y[0]) / (y[1] - y[0] || 1)) * (box.bottom - box.top);
  c.fillStyle = p.colour("dim");
  c.strokeStyle = p.colour("line");
  c.lineWidth = 1;
  c.beginPath();
  c.textBaseline = "middle";
  c.textAlign = "right";
  for (const v of ticks(y[0], y[1], Math.max((box.bottom - box.top) / 32, 3))) {
    c.moveTo(box.left, py(v)); c.lineTo(box.right, py(v)); c.fillText(minus(v), box.left - 6, py(v));
  }
  c.textBaseline = "top";
  c.textAlign = "center";
  for (const v of ticks(x[0], x[1], (box.right - box.left) / 90)) {
    c.moveTo(px(v), box.top); c.lineTo(px(v), box.bottom); c.fillText(minus(v), px(v), box.bottom + 5);
  }
  c.stroke();
  c.textAlign = "left";
  c.textBaseline = "alphabetic";
  c.fillText(title, 2, 12);
  const clip = (body) => { c.save(); c.beginPath(); c.rect(box.left, box.top - 4, box.right - box.left, box.bottom - box.top + 8); c.clip(); body(); c.restore(); };
  return {
    /** Joined by lines; a null, or a step in x beyond `gap`, breaks the line. */
    line(points, colour, width, { gap = Infinity, dash = [] } = {}) {
      clip(() => {
        c.strokeStyle = p.colour(colour); c.lineWidth = width; c.lineJoin = "round"; c.setLineDash(dash); c.beginPath();
        let last = null;
        for (const point of points) {
          const drawn = known(point[0]) && known(point[1]);
          if (drawn) last && point[0] - last[0] <= gap ? c.lineTo(px(point[0]), py(point[1])) : c.moveTo(px(point[0]), py(point[1]));
          last = drawn ? point : null;
        }
        c.stroke();
      });
    },
    marks(points, colour, radius, filled) {
      c.fillStyle = c.strokeStyle = p.colour(colour); c.lineWidth = 1.3;
      for (const [a, b] of points) if (known(a) && known(b)) { c.beginPath(); c.arc(px(a), py(b), radius, 0, 7); filled ? c.fill() : c.stroke(); }
    },
    vertical(v, colour, width, dash = []) { this.line([[v, y[0]], [v, y[1]]], colour, width, { dash }); },
    shade(low, high, colour) { clip(() => { c.fillStyle = p.colour(colour); c.globalAlpha = 0.18; c.fillRect(px(low), box.top, Math.max(px(high) - px(low), 2), box.bottom - box.top); }); },
  };
}

function drawLevelScale(l, share) {
  const p = prepare("level-scale"), c = p.context, abort = l?.abort_db ?? 6, end = abort + 1.5, y = 22, height = 16;
  const px = (db) => 6 + ((db + end) / (2 * end)) * (p.width - 12), db = (ratio) => 20 * Math.log10(ratio);
  const alarm = l?.alarm ?? 0.1;
  c.fillStyle = p.colour("line"); c.fillRect(px(-end), y, px(end) - px(-end), height);
  c.fillStyle = p.colour("band"); c.fillRect(px(-abort), y, px(abort) - px(-abort), height);
  c.globalAlpha = 0.35; c.fillStyle = p.colour("good");
  c.fillRect(px(db(1 - alarm)), y, px(db(1 + alarm)) - px(db(1 - alarm)), height); c.globalAlpha = 1;
  const mark = (value, colour, text, align, above) => {
    c.strokeStyle = c.fillStyle = p.colour(colour); c.lineWidth = 1.5;
    c.beginPath(); c.moveTo(px(value), y - 3); c.lineTo(px(value), y + height + 3); c.stroke();
    c.textAlign = align; c.fillText(text, px(value), above ? y - 7 : y + height + 16);
  };
  mark(-abort, "bad", `−${abort} dB stop`, "left"); mark(abort, "bad", `+${abort} dB stop`, "right");
  mark(db(1 - alarm), "warn", "", "right"); mark(db(1 + alarm), "warn", "", "left");
  mark(0, "ink", `demand, alarm ±${Math.round(100 * alarm)} %`, "center", true);
  if (share === null) return;
  const at = px(Math.max(-end, Math.min(end, db(Math.max(1 + share, 1e-3)))));
  c.fillStyle = p.colour("ink"); c.beginPath(); c.moveTo(at, y + 2); c.lineTo(at - 6, y + height + 4); c.lineTo(at + 6, y + height + 4); c.fill();
}

function drawTraces() {
  const { span_s: span, tracks } = state.trace;
  for (const [id, name, title, least] of [["u", "u", "u in mm, right positive", 0.1], ["force", "force", "contact force in kN, right positive", 0.1]]) {
    const points = Object.fromEntries(Object.entries(tracks).map(([track, t]) => [track, t.t.map((time, k) => [time, t[name][k]])]));
    $(id).hidden = name === "force" && !Object.values(points).flat().some(([, value]) => known(value));
    if ($(id).hidden) continue;
    const peak = Math.max(least, ...Object.values(points).flat().map(([, value]) => Math.abs(value ?? 0))), top = roundUp(peak);
    const axes = plot(id, [-span, 0], [-top, top], title + (id === "u" || $("force").hidden ? "" : "; time in s"));
    const gap = span / 40;
    axes.line(points.measured || [], "measured", 5, { gap });
    axes.line(points.free || [], "twin", 1.2, { gap });
    axes.line(points.window || [], "restarted", 1.4, { gap });
  }
}

function drawPrc() {
  const p = state.prc, f = p.forecast;
  $("prc-card").hidden = !p.range_hz;
  $("points").textContent = `${p.count} points`;
  $("forecast").textContent = !f ? "no jump forecast yet" : !f.kind ? "no jump ahead on this branch"
    : `next jump: ${f.kind} at ${digits(f.jump_hz, 4)} Hz (${digits(f.low_hz, 3)} to ${digits(f.high_hz, 3)})`;
  if (!p.range_hz) return;
  const all = p.curves.flatMap((curve) => curve.points), top = Math.max(0.1, ...all.map(([, value]) => value ?? 0)) * 1.05;
  const [low, high] = p.range_hz, pad = 0.02 * (high - low || 1);
  const axes = plot("prc", [low - pad, high + pad], [0, top], `${p.label} over Hz`);
  if (f && f.kind) { axes.shade(f.low_hz, f.high_hz, "jump"); axes.vertical(f.jump_hz, "jump", 1.5, [5, 4]); }
  if (known(p.step_hz)) axes.vertical(p.step_hz, "warn", 1.2);
  for (const { source, direction, points } of p.curves) {
    if (source === "twin") {
      axes.line(points, "twin", 1, direction === "forward" ? {} : { dash: [4, 3] });
      axes.marks(points, "twin", 4, false);
    } else {
      if (source === "measured") axes.line(points, direction, 2.5);
      axes.marks(points, direction, 3, true);
    }
  }
}

addEventListener("resize", () => { dirty = true; });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { dirty = true; });
listen();
draw();
