// A result: tables to sort and filter, maps with pan and zoom, positions and residuals over them.
import { $, digits, el } from "./dom.js";

const SHOWN = 200; // rows of a table at first
const result = await (await fetch("result")).json();
$("title").textContent = result.title;
$("kind").textContent = result.kind;
document.title = `${result.title} – pixmetry view`;

// ---- tables --------------------------------------------------------------------------------------------------------------------

const tables = result.tables.map((t) => ({ ...t, by: null, up: true, most: SHOWN, filter: "" }));

const source = (text) => typeof text === "string" && /^(scene|optics|sensor|electronics|cable|grabber|processing|storage)\.[a-z_]+$/.test(text);

function drawTable(t) {
  const words = (t.filter || $("find").value).toLowerCase().split(/\s+/).filter(Boolean);
  const hit = (row) => words.every((w) => row.some((v) => v !== null && String(v).toLowerCase().includes(w)) || t.name.toLowerCase().includes(w));
  let rows = t.rows.filter(hit);
  if (t.by !== null) {
    const key = (row) => row[t.by];
    const order = (a, b) => (a === null ? 1 : b === null ? -1 : typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
    rows = [...rows].sort((a, b) => (key(a) === null || key(b) === null ? order(key(a), key(b)) : (t.up ? 1 : -1) * order(key(a), key(b))));
  }
  const number = t.columns.map((_, k) => t.rows.slice(0, 50).some((r) => typeof r[k] === "number")), places = t.columns.includes("x_px") && t.columns.includes("y_px");
  const head = [...(places ? [el("th", { scope: "col", class: "hint" }, "map")] : []), ...t.columns.map((c, k) => el("th", { scope: "col", class: number[k] ? "n" : "", "aria-sort": t.by === k ? (t.up ? "ascending" : "descending") : "none" },
    el("button", { type: "button", onclick: () => { t.up = t.by === k ? !t.up : true; t.by = k; drawTable(t); } }, `${c}${t.by === k ? (t.up ? " ▲" : " ▼") : ""}`)))];
  const body = rows.slice(0, t.most).map((row) => el("tr", {}, places ? el("td", {}, el("button", { type: "button", "aria-label": "show on the map", title: "show on the map", onclick: () => goTo(t, row) }, "⌖")) : null, row.map((v, k) => el("td", { class: number[k] ? "n" : "" },
    source(v) ? el("button", { type: "button", title: "what the result says of this source", onclick: () => evidence(v) }, v) : v === null ? "" : typeof v === "number" ? digits(v, 6) : String(v)))));
  const more = rows.length > t.most ? el("button", { type: "button", onclick: () => { t.most *= 5; drawTable(t); } }, `more of ${rows.length} rows`) : null;
  t.box.hidden = rows.length === 0;
  t.count.textContent = ` ${rows.length === t.rows.length ? rows.length : `${rows.length} of ${t.rows.length}`} row${rows.length === 1 ? "" : "s"}${t.cut ? `; the file has ${t.cut}` : ""}`;
  t.body.replaceChildren(el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": t.name }, el("table", {}, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body))), ...(more ? [more] : []));
}

// From a row of the budget to what is known of its source: all rows that name it, in all tables.
function evidence(name) {
  $("find").value = name;
  const map = result.maps.findIndex((m) => m.includes(name.split(".")[1]));
  if (map >= 0) showMap(map);
  for (const t of tables) t.filter = t.own.value = "";
  redraw();
  for (const t of tables) t.box.open = !t.box.hidden;
  $("find").scrollIntoView({ block: "start" });
  $("find").focus();
}

function redraw() { tables.forEach((t) => { if (t.box.open || $("find").value) drawTable(t); }); }

for (const t of tables) {
  t.count = el("span", { class: "hint" });
  t.body = el("div");
  const own = el("input", { type: "search", placeholder: "in this table", "aria-label": `find in ${t.name}`, oninput: () => { t.filter = own.value; drawTable(t); } });
  t.own = own;
  t.box = el("details", {}, el("summary", {}, t.name, t.count), el("div", { class: "row" }, own), t.body);
  t.count.textContent = ` ${t.rows.length} row${t.rows.length === 1 ? "" : "s"}`;
  t.box.addEventListener("toggle", () => { if (t.box.open) drawTable(t); });
  $("tables").append(t.box);
}
if (tables.length) tables[0].box.open = true;
$("find").addEventListener("input", () => { redraw(); for (const t of tables) { if (!$("find").value) t.box.hidden = false; } });
$("all").addEventListener("click", () => { $("find").value = ""; for (const t of tables) { t.box.hidden = false; if (t.box.open) drawTable(t); } });

// ---- maps and positions --------------------------------------------------------------------------------------------------------

const sheet = $("sheet"), placed = tables.filter((t) => t.columns.includes("x_px") && t.columns.includes("y_px"));
const view = { map: null, canvas: null, x: 0, y: 0, zoom: 1, points: [] };

if (result.maps.length || placed.length) {
  $("maps").hidden = false;
  $("map").append(...(result.maps.length ? [] : [el("option", { value: -1 }, "none")]), ...result.maps.map((m, k) => el("option", { value: k }, m)));
  $("points").append(el("option", { value: -1 }, "none"), ...placed.map((t, k) => el("option", { value: k }, t.name)));
  if (placed.length) $("points").value = 0;
  showImages();
  const first = result.maps.findIndex((m) => [...$("image").options].some((o) => o.value === m));
  if (first >= 0) $("image").value = result.maps[first];
  await showMap(Math.max(first, 0));
}

// Show a map; if it is the picture of an image of the table, the positions of that image alone.
async function showMap(k) {
  const name = result.maps[k];
  $("map").value = result.maps.length ? k : -1;
  if ([...$("image").options].some((o) => o.value === name)) $("image").value = name;
  choosePoints();
  await load();
}

async function load() {
  const k = Number($("map").value), mine = (view.asked = {});
  if (k >= 0) {
    let map;
    try {
      map = await (await fetch(`map/${k}`)).json();
    } catch {
      map = { error: "the server does not answer: is the command still running?" };
    }
    if (view.asked !== mine) return; // another was chosen meanwhile
    $("said").textContent = map.error ?? "";
    if (map.error || map.overtaken) return;
    const values = new Float32Array(Uint8Array.from(atob(map.data), (c) => c.charCodeAt(0)).buffer);
    const canvas = el("canvas"), image = new ImageData(map.cols, map.rows);
    canvas.width = map.cols;
    canvas.height = map.rows;
    for (let i = 0; i < values.length; i++) {
      const grey = (255 * (values[i] - map.low)) / (map.high - map.low);
      image.data.set(Number.isFinite(values[i]) ? [grey, grey, grey, 255] : [200, 0, 80, 255], 4 * i);
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    const same = view.map && view.map.cols * view.map.step === map.cols * map.step && view.map.rows * view.map.step === map.rows * map.step;
    Object.assign(view, { map: { ...map, values }, canvas });
    if (same) { draw(); return; } // the part that is looked at stays
  }
  whole();
}

// A row of a table of positions, in the middle of the map.
async function goTo(t, row) {
  const at = Object.fromEntries(t.columns.map((c, k) => [c, k]));
  $("points").value = placed.indexOf(t);
  showImages();
  const image = "image" in at ? String(row[at.image]) : "", map = result.maps.indexOf(image);
  $("image").value = image;
  if (map >= 0 && map !== Number($("map").value)) await showMap(map);
  choosePoints();
  if (row[at.x_px] === null || row[at.y_px] === null) return;
  const [w] = size();
  view.zoom = Math.max(view.zoom, (8 * sheet.width) / w);
  view.x = row[at.x_px] + 0.5 - sheet.width / view.zoom / 2;
  view.y = row[at.y_px] + 0.5 - sheet.height / view.zoom / 2;
  draw();
  $("under").textContent = told(t.columns, row);
  sheet.scrollIntoView({ block: "nearest" });
  sheet.focus();
}

const told = (columns, row) => columns.map((c, k) => `${c} ${typeof row[k] === "number" ? digits(row[k], 5) : row[k] ?? "–"}`).slice(0, 10).join(", ");

function columnsOf(t) { return t ? Object.fromEntries(t.columns.map((c, k) => [c, k])) : {}; }

function showImages() {
  const t = placed[Number($("points").value)], at = columnsOf(t), before = $("image").value;
  const images = t && "image" in at ? [...new Set(t.rows.map((r) => String(r[at.image])))] : [];
  $("image").replaceChildren(el("option", { value: "" }, "all"), ...images.map((name) => el("option", { value: name }, name)));
  if (images.includes(before)) $("image").value = before;
}

function choosePoints() {
  const t = placed[Number($("points").value)], at = columnsOf(t);
  view.points = (t?.rows ?? []).filter((r) => !$("image").value || String(r[at.image]) === $("image").value).filter((r) => r[at.x_px] !== null && r[at.y_px] !== null)
    .map((r) => ({ x: r[at.x_px], y: r[at.y_px], dx: "residual_x_px" in at ? r[at.residual_x_px] : null, dy: "residual_y_px" in at ? r[at.residual_y_px] : null, row: r, columns: t.columns }));
}

function size() {
  if (view.map) return [view.map.cols * view.map.step, view.map.rows * view.map.step];
  return ["x", "y"].map((axis) => view.points.reduce((most, p) => Math.max(most, p[axis]), 1) + 10);
}

function whole() {
  const box = sheet.parentElement.clientWidth;
  sheet.width = box * devicePixelRatio;
  sheet.height = Math.min(0.62 * box, 640) * devicePixelRatio;
  const [w, h] = size();
  view.zoom = Math.min(sheet.width / w, sheet.height / h);
  view.x = (w - sheet.width / view.zoom) / 2;
  view.y = (h - sheet.height / view.zoom) / 2;
  draw();
}

function draw() {
  const pen = sheet.getContext("2d"), { zoom, x, y } = view, scale = Number($("scale").value) || 1;
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.fillStyle = view.map ? "#222" : "#111";
  pen.fillRect(0, 0, sheet.width, sheet.height);
  pen.imageSmoothingEnabled = false;
  if (view.canvas) pen.drawImage(view.canvas, -x * zoom, -y * zoom, view.canvas.width * view.map.step * zoom, view.canvas.height * view.map.step * zoom);
  pen.lineWidth = 1.5 * devicePixelRatio;
  const r = 3 * devicePixelRatio;
  for (const p of view.map?.frame === false ? [] : view.points) {
    const [px, py] = [(p.x + 0.5 - x) * zoom, (p.y + 0.5 - y) * zoom];
    if (px < -50 || py < -50 || px > sheet.width + 50 || py > sheet.height + 50) continue;
    pen.strokeStyle = "#39a7ff";
    pen.beginPath();
    pen.moveTo(px - r, py); pen.lineTo(px + r, py); pen.moveTo(px, py - r); pen.lineTo(px, py + r);
    pen.stroke();
    if (p.dx === null || p.dy === null) continue;
    pen.strokeStyle = "#ffb03a";
    pen.beginPath();
    pen.moveTo(px, py); pen.lineTo(px + p.dx * scale * zoom, py + p.dy * scale * zoom);
    pen.stroke();
  }
  sheet.setAttribute("aria-label", `${view.map?.name ?? "no map"}; ${view.points.length} positions`);
}

function zoomAt(factor, px = sheet.width / 2, py = sheet.height / 2) {
  const [x, y] = [view.x + px / view.zoom, view.y + py / view.zoom];
  view.zoom = Math.min(Math.max(view.zoom * factor, 0.01), 200);
  view.x = x - px / view.zoom;
  view.y = y - py / view.zoom;
  draw();
}

function tell(event) {
  const box = sheet.getBoundingClientRect();
  const px = (event.clientX - box.left) * (sheet.width / box.width), py = (event.clientY - box.top) * (sheet.height / box.height);
  const x = view.x + px / view.zoom - 0.5, y = view.y + py / view.zoom - 0.5;
  let words = `x ${x.toFixed(1)}, y ${y.toFixed(1)} px`;
  if (view.map) {
    const col = Math.floor((x + 0.5) / view.map.step), row = Math.floor((y + 0.5) / view.map.step);
    if (col >= 0 && row >= 0 && col < view.map.cols && row < view.map.rows) words += `; ${view.map.name} ${digits(view.map.values[row * view.map.cols + col], 5)}`;
  }
  let near = null, least = (12 * devicePixelRatio) / view.zoom;
  for (const p of view.points) {
    const far = Math.hypot(p.x - x, p.y - y);
    if (far < least) [near, least] = [p, far];
  }
  if (near) words += `; ${told(near.columns, near.row)}`;
  $("under").textContent = words;
  return [px, py];
}

// One pointer moves the map, two zoom it.
const held = new Map();
const drop = (e) => held.delete(e.pointerId);
sheet.addEventListener("pointerdown", (e) => { held.set(e.pointerId, tell(e)); sheet.setPointerCapture(e.pointerId); });
for (const kind of ["pointerup", "pointercancel"]) sheet.addEventListener(kind, drop);
sheet.addEventListener("pointermove", (e) => {
  const now = tell(e), before = held.get(e.pointerId);
  if (!before) return;
  const other = [...held].find(([id]) => id !== e.pointerId)?.[1];
  held.set(e.pointerId, now);
  if (other) {
    const apart = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
    zoomAt(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    return;
  }
  view.x -= (now[0] - before[0]) / view.zoom;
  view.y -= (now[1] - before[1]) / view.zoom;
  draw();
});
sheet.addEventListener("wheel", (e) => { e.preventDefault(); zoomAt(Math.exp(-e.deltaY / 400), ...tell(e)); }, { passive: false });
sheet.addEventListener("keydown", (e) => {
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if (by) { e.preventDefault(); view.x += (by[0] * sheet.width) / view.zoom / 10; view.y += (by[1] * sheet.height) / view.zoom / 10; draw(); }
  if (e.key === "+") zoomAt(1.4);
  if (e.key === "-") zoomAt(1 / 1.4);
});
$("closer").addEventListener("click", () => zoomAt(1.4));
$("farther").addEventListener("click", () => zoomAt(1 / 1.4));
$("whole").addEventListener("click", whole);
$("map").addEventListener("change", () => showMap(Number($("map").value)));
$("points").addEventListener("change", () => { showImages(); choosePoints(); draw(); });
$("image").addEventListener("change", () => {
  const map = result.maps.indexOf($("image").value);
  if (map >= 0) showMap(map);
  else { choosePoints(); draw(); }
});
$("scale").addEventListener("input", draw);
let wide = innerWidth;
window.addEventListener("resize", () => { if (innerWidth !== wide) { wide = innerWidth; whole(); } }); // a telephone hides its bar: that is no reason
document.body.dataset.ready = "1";
