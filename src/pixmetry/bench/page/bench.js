// The bench: one state, what the server makes of it, and what shows it.
import { $, digits, el, mpx, packed, px, unpacked } from "./dom.js";
import { Follow, Latest, once } from "./ask.js";
import { drawFound, errorText, paint, profiles, screen } from "./draw.js";
import { control } from "./controls.js";
import { makeViews, refresh, show as showView } from "./views.js";
import { takeAway } from "./away.js";

const REST_MS = 160; // without a move, before the slow things are asked for
const LEAST_SHARE = 1e-4; // of the error, from which on a source that the camera is not described with is shown in the chain
const CALM_SHARE = 0.15; // of the error, from which on a source stands out

const bench = { catalogue: null, state: {}, camera: null, picture: null, codes: null, found: null, rows: new Map(), budget: null, together: null, stale: false, before: false };
window.bench = bench; // for tests and for the curious
let answered = 0;
bench.answers = () => answered; // pictures and refusals so far
bench.busy = () => pictures.busy;

const said = (text) => { $("said").textContent = text ?? ""; };

// ---- asking ------------------------------------------------------------------------------------------------------------------

const failed = (text) => { said(text); answered++; };
const pictures = new Latest("picture", showPicture, failed);
const foundIn = new Latest("found", showFound, failed);
const cameras = new Latest("camera", showCamera, failed);
const budgets = new Follow("budget", showLine, said);
let resting = 0;
let serial = 0; // of the state: an answer about an older one is not shown over a newer one

const keepLink = () => history.replaceState(null, "", `#${packed(bench.state)}`); // not at every move: browsers allow few in a second

function changed(redraw = false) {
  serial++;
  said("");
  $("pictures").classList.add("settling"); // what is said of the picture is of the one before, until it is computed anew
  pictures.ask(bench.state);
  bench.stale = true;
  budgets.stop();
  clearTimeout(resting);
  resting = setTimeout(rest, REST_MS);
  if (redraw) cameras.ask(bench.state, serial);
}

function rest() {
  if (pictures.busy) { resting = setTimeout(rest, REST_MS / 4); return; }
  keepLink();
  foundIn.ask(bench.state, serial);
  refresh();
  cameras.ask(bench.state, serial);
  bench.rows = new Map();
  bench.together = null;
  budgets.ask(bench.state);
  if (bench.other) askOther();
}

// ---- the picture -------------------------------------------------------------------------------------------------------------

let shown = null;

function showPicture(answer) {
  bench.picture = answer.picture;
  const stale = bench.found ? { true_px: answer.true_px, found_px: null } : { true_px: answer.true_px };
  if (!shown || shown.cols !== answer.picture.cols || shown.rows !== answer.picture.rows) {
    const made = screen(answer.picture, "The target");
    const caption = el("figcaption", {}, el("b", {}, "as it is"), " ", el("span"));
    const figure = el("figure", { id: "as-it-is" }, made.box, caption);
    shown = { ...made, cols: answer.picture.cols, rows: answer.picture.rows, text: caption.lastChild };
    $("pictures").replaceChildren(figure);
  }
  bench.codes = paint(shown.canvas, answer.picture);
  drawFound(shown.over, answer.picture, { ...stale });
  $("profiles").replaceChildren(...profiles(answer.picture, { true_px: answer.true_px }, bench.codes));
  answered++;
  document.body.dataset.drawn = String(Number(document.body.dataset.drawn ?? 0) + 1);
}

function showFound(answer, asked) {
  if (asked !== serial) return;
  bench.found = answer.found;
  $("pictures").classList.remove("settling");
  if (!shown || !bench.picture) return;
  drawFound(shown.over, bench.picture, answer.found);
  shown.text.textContent = errorText(answer.found);
  shown.canvas.setAttribute("aria-label", `The target as the camera stores it; ${errorText(answer.found)}`);
  $("profiles").replaceChildren(...profiles(bench.picture, answer.found, bench.codes));
  document.getElementById("beside")?.remove();
  if (answer.beside) {
    const made = screen(answer.beside, `The target without the chosen source; ${errorText(answer.beside_found)}`);
    drawFound(made.over, answer.beside, answer.beside_found);
    const title = bench.catalogue.sources[sourceOf(bench.state.chosen)]?.title ?? "the chosen source";
    $("pictures").append(el("figure", { id: "beside" }, made.box, el("figcaption", {}, el("b", {}, `without: ${title.toLowerCase()}`), " ", errorText(answer.beside_found))));
  }
  document.body.dataset.found = String(Number(document.body.dataset.found ?? 0) + 1);
}

// ---- the camera and its chain --------------------------------------------------------------------------------------------------

const sourceOf = (name) => bench.camera?.chain.find((e) => e.name === name)?.source ?? name;

function showCamera(camera, asked) {
  if (asked !== serial) return;
  const first = bench.camera === null || bench.camera.name !== camera.name || bench.camera.chain.length !== camera.chain.length;
  bench.camera = camera;
  showChain();
  if (first || bench.panel !== panelMark()) showSource();
  if (first || bench.redrawScenario) showScenario();
  bench.redrawScenario = false;
}

const panelMark = () => `${bench.state.chosen}|${bench.camera.chain.find((e) => e.name === bench.state.chosen)?.on}|${bench.camera.name}|${bench.camera.chain.length}`;

const share = (row) => (row && bench.shares?.[row.name]?.[bench.before ? 1 : 0]) || 0;

const counted = (row) => ["measured", "from the sheet", "described", "typical"].includes(row.status);

// The chip of a source. It is made once and changed in place, so that neither focus nor a click on it is lost while rows come in.
const chips = { chain: new Map(), absent: new Map() };

function chip(where, name, title, on, changedHere, row) {
  if (!chips[where].has(name)) chips[where].set(name, el("li", {}, el("button", { type: "button", "data-source": name, onclick: () => choose(name) }, el("i", { "aria-hidden": "true" }), el("span"), el("b"))));
  const item = chips[where].get(name), button = item.firstChild, [bar, words, number] = button.children;
  const part = share(row), size = row && (bench.before ? row.before_px : row.after_px);
  button.className = `chip${part > CALM_SHARE ? " large" : ""}${on ? "" : " off"}${changedHere ? " changed" : ""}`;
  button.setAttribute("aria-pressed", String(bench.state.chosen === name));
  button.setAttribute("aria-label", `${title}${on ? "" : ", switched off"}${changedHere ? ", changed" : ""}${part && !bench.stale ? `, ${digits(100 * part, 2)} % of the error` : ""}`);
  bar.style.width = `${(100 * Math.sqrt(part)).toFixed(1)}%`;
  words.textContent = title;
  number.textContent = on && size > 5e-6 ? mpx(size).replace(" mpx", "") : "";
  return item;
}

// Give a list these items; where they are there already, in this order, nothing is touched.
function list(box, items) {
  if (box.children.length !== items.length || items.some((item, k) => box.children[k] !== item)) {
    const focused = box.contains(document.activeElement) ? document.activeElement : null;
    box.replaceChildren(...items);
    if (focused && box.contains(focused)) focused.focus();
  }
}

const heads = new Map();

function showChain() {
  const { catalogue, camera } = bench;
  const rows = new Map([...bench.rows.values()].map((r) => [r.name, r]));
  const stages = catalogue.stages.map((stage) => {
    const there = camera.chain.filter((e) => catalogue.sources[e.source].stage === stage.id).map((e) => [e.name, e]);
    const more = [...rows.values()].filter((r) => !camera.chain.some((e) => e.source === r.source_id) && counted(r) && share(r) > LEAST_SHARE && catalogue.sources[r.source_id]?.stage === stage.id);
    const whole = [...there.map(([n]) => rows.get(n)), ...more].reduce((s, r) => s + share(r), 0);
    const items = there.map(([n, e]) => chip("chain", n, catalogue.sources[e.source].title, e.on, hasChanges(n), rows.get(n)));
    items.push(...more.map((r) => chip("chain", r.name, `${r.title} (typical)`, true, false, r)));
    if (!heads.has(stage.id)) heads.set(stage.id, el("li", { "data-stage": stage.id }, el("div", { class: "stage" }, el("span", {}, stage.title), el("span")), el("ul")));
    const head = heads.get(stage.id);
    head.className = items.length > 12 ? "long" : "";
    head.querySelector(".stage").lastChild.textContent = whole >= 0.0005 && !bench.stale ? `${digits(100 * whole, 2)} %` : "";
    head.style.borderTopColor = whole > 0 ? `color-mix(in srgb, var(--hot) ${Math.round(100 * Math.sqrt(whole))}%, var(--grid))` : "";
    list(head.lastChild, items);
    return head;
  });
  list($("chain"), stages);
  const absent = Object.values(catalogue.sources).filter((s) => !camera.chain.some((e) => e.source === s.id));
  list($("absent-list"), absent.map((s) => chip("absent", s.id, s.title, true, false, rows.get(s.id))));
}

function choose(name) {
  bench.state.chosen = name;
  keepLink();
  showChain();
  showSource();
  showBars();
  foundIn.ask(bench.state, serial);
}

// ---- the source that is looked at ----------------------------------------------------------------------------------------------

function showSource() {
  const name = bench.state.chosen, element = bench.camera.chain.find((e) => e.name === name), source = bench.catalogue.sources[element?.source ?? name];
  bench.panel = panelMark();
  const body = $("source-body");
  if (!source) {
    $("source-title").textContent = "Source";
    body.replaceChildren(el("p", { class: "hint" }, "Choose a source in the chain: its equation, its parameters and what it does appear here."));
    return;
  }
  $("source-title").textContent = source.title;
  const parts = [];
  const stars = "★".repeat(source.stars) + "☆".repeat(5 - source.stars);
  parts.push(el("p", { class: "hint" }, el("span", { class: "stars", role: "img", "aria-label": `${source.stars} of 5 stars in the handbook` }, source.number ? stars : ""), ` ${source.number ? `row ${source.number} of the handbook's table` : "not in the handbook's table"}${source.note ? `, ${source.note}` : ""} · ${source.id}`));
  parts.push(el("p", { class: "about" }, source.description));
  parts.push(el("p", { class: "about", id: "cost", role: "status" }));
  if (source.equation) parts.push(el("p", { class: "equation" }, source.equation));
  const row = el("div", { class: "row" });
  if (element) {
    const box = el("input", { type: "checkbox", id: "on", checked: element.on, disabled: element.essential, onchange: () => turn(name, box.checked) });
    row.append(el("span", { class: "switch" }, box, el("label", { for: "on" }, element.essential ? "on (no frame is made without it)" : "on")));
    row.append(el("button", { type: "button", onclick: () => setAll(name, source, "typical") }, "typical"), el("button", { type: "button", onclick: () => setAll(name, source, "bound") }, "at the bound"));
    row.append(el("button", { type: "button", id: "undo", disabled: !hasChanges(name), onclick: () => undo(name) }, "undo"));
    if (element.added) row.append(el("button", { type: "button", onclick: () => remove(name) }, "take out"));
  } else if (source.in_frames) {
    row.append(el("button", { type: "button", id: "add", onclick: () => add(source) }, "Put it into this camera"));
  } else {
    row.append(el("span", { class: "hint" }, source.reasons.forward ?? ""));
  }
  parts.push(row);
  for (const c of source.controls) {
    if (!element) continue;
    const key = `${name}.${c.name}`;
    const made = control({ ...c, value: element.values[c.name] }, (v) => set(key, v, made.box), { key });
    made.box.classList.toggle("changed", element.changed.includes(c.name));
    parts.push(made.box);
  }
  parts.push(el("p", { class: "about" }, el("b", {}, "Usual size: "), source.typical_size), el("p", { class: "about" }, el("b", {}, "What to do: "), source.advice));
  parts.push(el("details", {}, el("summary", {}, "References"), el("ul", {}, source.references.map((r) => el("li", { class: "about" }, r)))));
  body.replaceChildren(...parts);
  showCost();
}

function set(key, value, box) {
  bench.state.set = { ...bench.state.set, [key]: value };
  box?.classList.add("changed");
  if ($("undo")) $("undo").disabled = !hasChanges(bench.state.chosen);
  changed();
}

const hasChanges = (name) => Object.keys(bench.state.set ?? {}).some((key) => key.slice(0, key.lastIndexOf(".")) === name);

function setAll(name, source, which) {
  const values = { ...bench.state.set };
  for (const c of source.controls) if (c.kind !== "fixed") values[`${name}.${c.name}`] = c[which];
  bench.state.set = values;
  bench.panel = null;
  changed(true);
}

function undo(name) {
  bench.state.set = Object.fromEntries(Object.entries(bench.state.set).filter(([k]) => k.slice(0, k.lastIndexOf(".")) !== name));
  bench.panel = null;
  changed(true);
}

function turn(name, on) {
  const without = (list) => (list ?? []).filter((n) => n !== name);
  const start = !(bench.state.off ?? []).includes(name) && !(bench.state.on ?? []).includes(name);
  bench.state.off = without(bench.state.off);
  bench.state.on = without(bench.state.on);
  if (start && !on) bench.state.off.push(name);
  if (start && on) bench.state.on.push(name);
  changed(true);
}

function add(source) {
  bench.state.add = [...(bench.state.add ?? []), source.id];
  const values = { ...bench.state.set };
  const ofTheCamera = ["bits", "reference_dn", "pitch_um", "pitch_x_um", "pitch_y_um"]; // the server knows these of its other sources
  for (const c of source.controls) if (c.kind !== "fixed" && !ofTheCamera.includes(c.name)) values[`${source.id}.${c.name}`] = c.typical;
  bench.state.set = values;
  bench.state.chosen = source.id;
  bench.panel = null;
  changed(true);
}

function remove(name) {
  bench.state.add = bench.state.add.filter((n) => n !== name);
  undo(name);
}

// ---- scenario ------------------------------------------------------------------------------------------------------------------

const PARTS = { target: "Target", light: "Light", motion: "Motion", state: "Warm-up", count: "Frames, targets, rays", calibration: "Calibration", storage: "Storage", object: "Object and lens", goal: "What is wanted" };

function showScenario() {
  const { catalogue, camera } = bench;
  const boxes = Object.entries(catalogue.scenario).map(([part, controls]) => {
    const made = controls.map((c) => {
      const value = camera.scenario[`${part}.${c.name}`];
      return control({ ...c, value, unit: unitOf(c.name) }, (v) => setScenario(part, c.name, v), { title: plainName(c.name), key: `${part}.${c.name}` }).box;
    });
    if (part === "target") made.unshift(...sceneNote()), made.push(...placeControls());
    return el("details", { open: part === "target" }, el("summary", {}, PARTS[part] ?? part), made);
  });
  const own = catalogue.own.map((c) => control({ ...c, value: camera.own[c.name] }, (v) => set(c.name, v), { title: plainName(c.name), key: c.name }).box);
  const seed = control({ name: "seed", kind: "int", low: 0, high: 1000, unit: "", text: "of the noise of this frame", value: bench.state.seed ?? 0 }, (v) => { bench.state.seed = v; changed(); }).box;
  boxes.push(el("details", {}, el("summary", {}, "Exposure, temperature, unit"), own, seed));
  const open = new Set([...document.querySelectorAll("#scenario details")].filter((d) => d.open).map((d) => d.firstChild.textContent));
  $("scenario").replaceChildren(...boxes);
  for (const d of $("scenario").children) if (open.has(d.firstChild.textContent)) d.open = true;
}

// With a scene file, the picture is of that file; what is said of the target is for the budget alone.
function sceneNote() {
  if (!bench.state.scene) return [];
  const back = () => begin({ ...bench.state, scene: null, x_px: null, y_px: null });
  return [el("p", { class: "hint", id: "of-a-file" }, "The picture shows the scene file. Light, target and motion here are those of the budget. ", el("button", { type: "button", onclick: back }, "One target in place of the scene"))];
}

function placeControls() {
  const { cols, rows, place_px: at } = bench.camera;
  return [["x_px", cols - 1, at[0]], ["y_px", rows - 1, at[1]]].map(([name, high, value]) =>
    control({ name, kind: "float", low: 0, high, unit: "px", text: bench.state.scene ? "the nearest target is shown" : "place in the scene", value }, (v) => { bench.state[name] = v; changed(); }, { title: plainName(name), key: name }).box);
}

const UNITS = { px: "px", mm: "mm", s: "s", hz: "Hz", nm: "nm", deg: "°", min: "min", k: "K", s2: "s²" };
function unitOf(name) {
  const [, top, below] = /_(px|mm|s|hz|nm|deg|min|k)(?:_per_(px|s2|s))?$/.exec(name) ?? [];
  return top ? UNITS[top] + (below ? `/${UNITS[below]}` : "") : "";
}
const plainName = (name) => name.replace(/_(px|mm|s|hz|nm|deg|min|k|rel|c)(_per_(px|s2|s))?$/, "").replaceAll("_", " ");

function setScenario(part, name, value) {
  const own = { ...(bench.state.scenario?.[part] ?? {}) };
  if (value === null) delete own[name];
  else own[name] = value;
  bench.state.scenario = { ...bench.state.scenario, [part]: own };
  changed();
}

// ---- numbers -------------------------------------------------------------------------------------------------------------------

let drawing = 0;

function showLine(line) {
  if (line.kind === "error") { said(line.text); $("settling").textContent = ""; return; }
  if (line.error || line.overtaken) { if (line.error) said(line.error); return; }
  if (line.kind === "begin") bench.of = line.rows;
  if (line.kind === "row") { bench.rows.set(line.row.name, line.row); bench.shares = line.shares; }
  if (line.kind === "budget") {
    bench.budget = line.budget;
    bench.rows = new Map(line.budget.rows.map((r) => [r.name, r]));
    bench.shares = line.budget.shares;
    bench.stale = false;
    if (bench.other) showOther();
    document.body.dataset.budget = String(Number(document.body.dataset.budget ?? 0) + 1);
  }
  if (line.kind === "together") bench.together = line;
  if (!drawing) drawing = requestAnimationFrame(() => { drawing = 0; showNumbers(); });
}

function showNumbers() {
  if (!bench.camera) return;
  showChain();
  showBars();
  showCost();
  showHeadline();
}

// The answer to "what does this cost me?"
function showCost() {
  const row = bench.rows.get(bench.state.chosen), box = $("cost");
  if (!box) return;
  const known = row && counted(row);
  box.textContent = known ? `Here it moves a position by ${px(row.before_px)} before a calibration and by ${px(row.after_px)} after it (k = 1, rms of x and y).` : "";
}

function showHeadline() {
  const box = $("headline"), b = bench.budget;
  box.classList.toggle("stale", bench.stale);
  const count = bench.rows.size, state = bench.stale ? `${count} of ${bench.of ?? "…"} sources computed` : bench.together ? simulated() : "simulating all sources at once …";
  $("settling").textContent = state;
  if (!b) return;
  const one = b.one_target_one_frame, pair = bench.before ? one.before_px : one.after_px;
  const parts = [el("div", { class: "big" }, ...["x", "y"].map((axis, k) => el("span", {}, el("i", {}, axis), px(pair[k]))))];
  parts.push(el("p", {}, bench.before ? "one target in one frame, without a calibration (k = 1)" : "one target in one frame, after calibration (k = 1)"));
  parts.push(el("p", {}, `rms of x and y after calibration ${px(b.rms_px.after)}: between ${px(b.rms_px.least)} (only what is known) and ${px(b.rms_px.most)} (the rest at its bound)`));
  if (one.after_mm) parts.push(el("p", {}, `on the object: ${digits(one.after_mm[0], 2)} mm × ${digits(one.after_mm[1], 2)} mm`));
  const m = b.answer;
  if (m.frames > 1 || m.targets > 1) parts.push(el("p", {}, `mean over ${m.frames} frames and ${m.targets} targets: x ${px(m.after_px[0])}, y ${px(m.after_px[1])}`));
  if (b.goal_text) parts.push(el("p", {}, b.goal_text));
  const next = b.to_change.find((s) => s.worth);
  if (next) parts.push(el("p", {}, el("b", {}, "Change first: "), `${next.title}; without it ${px(next.then_px)} in place of ${px(next.now_px)}`));
  box.replaceChildren(...parts);
}

function simulated() {
  const t = bench.together.together;
  return `all sources of the chain at once, simulated in ${t.trials} windows: ${digits(t.total_px, 3)} ± ${digits(t.se_total_px, 1)} px, after a calibration ${digits(t.calibrated_px, 3)} ± ${digits(t.se_calibrated_px, 1)} px${bench.together.last ? "" : " …"}`;
}

const KINDS = ["constant", "smooth", "place", "time"], lines = new Map();

function showBars() {
  const size = (r) => (bench.before ? r.before_px : r.after_px) || 0;
  const rows = [...bench.rows.values()].filter((r) => counted(r) && size(r) > 1e-6).sort((a, b) => size(b) - size(a)).slice(0, 24);
  const most = Math.max(...rows.map(size), 1e-12);
  list($("bars"), rows.map((r) => {
    if (!lines.has(r.name)) lines.set(r.name, el("li", {}, el("button", { type: "button", "data-source": r.name, onclick: () => choose(r.name) }, el("span"), el("span", { class: "bar", "aria-hidden": "true" }, KINDS.map((n) => el("i", { class: n }))), el("em"))));
    const item = lines.get(r.name), button = item.firstChild, [title, bar, number] = button.children, parts = (bench.before ? r.before : r.after)?.kinds ?? {};
    KINDS.forEach((n, k) => { bar.children[k].style.width = `${((100 * size(r)) / most) * (parts[n] ?? 0)}%`; });
    title.textContent = r.title;
    number.textContent = mpx(size(r));
    button.title = `${r.status}; ${r.how}${r.reason ? `; ${r.reason}` : ""}`;
    button.setAttribute("aria-pressed", String(bench.state.chosen === r.name));
    button.setAttribute("aria-label", `${r.title}: ${mpx(size(r))}, ${KINDS.filter((n) => parts[n] > 0.01).join(", ")}`);
    return item;
  }));
}

// ---- begin ---------------------------------------------------------------------------------------------------------------------

function fillChoices() {
  const { catalogue, cameras: names } = bench;
  const group = (label, list) => el("optgroup", { label }, list.map((n) => el("option", { value: n }, n)));
  const given = names.filter((n) => n === "given");
  $("camera").replaceChildren(...(given.length ? [group("Of the command line", given)] : []), group("Presets", catalogue.presets), group("Data sheets", catalogue.sheets), el("optgroup", { label: "File" }, el("option", { value: "file", disabled: true }, "an opened file")));
  $("other-camera").append(...names.map((n) => el("option", { value: n }, n)));
  $("note").append(...catalogue.notes.map((n) => el("option", { value: n.number }, `${n.number} ${n.title}`)));
  $("estimator").replaceChildren(...catalogue.estimators.map((n) => el("option", { value: n }, n.replaceAll("_", " "))));
}

function showState() {
  $("camera").value = bench.state.record ? "file" : bench.state.camera;
  $("estimator").value = bench.state.estimator ?? "auto";
  $("side").value = bench.state.side_px ?? 128;
  bench.camera = null;
  bench.budget = null;
  bench.rows = new Map();
  bench.found = null;
  $("beside")?.remove();
  if (shown) shown.text.textContent = "";
  $("headline").replaceChildren(el("p", {}, "The budget is being computed; its rows appear below as they are known."));
  changed(true);
}

export function begin(state) {
  bench.state = { camera: bench.first, set: {}, scenario: {}, chosen: "", ...state };
  bench.panel = null;
  showState();
}

function showLesson(note) {
  const box = $("lesson");
  box.hidden = !note;
  $("note").value = note?.number ?? "";
  if (note?.view) box.after($("views")); // what the note is about, without scrolling
  else $("measured").before($("views"));
  if (note) box.replaceChildren(el("p", {}, el("b", {}, `Note ${note.number}: ${note.title}. `), note.text));
}

$("note").addEventListener("change", () => {
  const note = bench.catalogue.notes.find((n) => String(n.number) === $("note").value);
  showLesson(note);
  if (!note) return;
  begin(structuredClone(note.state));
  showView(note.view);
});
$("open").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", async () => {
  const [file] = $("file").files;
  $("file").value = "";
  if (!file) return;
  try {
    if (file.size > 400000) throw new Error("the file is too large for a camera file");
    const { record, scene, target } = await once("read", { text: await file.text() });
    const { scenario, estimator } = bench.state;
    if (scene) begin({ ...bench.state, scene, scenario: { ...scenario, target: { ...scenario?.target, ...target } }, x_px: null, y_px: null });
    else begin({ record, scenario, estimator, scene: bench.state.scene });
  } catch (problem) {
    said(`${file.name}: ${problem.message}`);
  }
});
$("take").addEventListener("click", () => takeAway(bench));

// ---- two cameras side by side --------------------------------------------------------------------------------------------------

const forOther = (part) => (answer, asked) => { if (bench.other?.state === asked) { bench.other[part] = answer[part]; showOther(); } };
const otherFound = new Latest("found", forOther("found"), failed, "-beside");
const otherPicture = new Latest("picture", forOther("picture"), failed, "-beside");
const otherBudget = new Follow("budget", (line) => {
  if (!bench.other) return;
  if (line.kind === "budget") bench.other.budget = line.budget;
  if (line.kind === "row") bench.other.count++;
  if (line.error || line.kind === "error") bench.other.problem = line.error ?? line.text;
  if (line.kind !== "together") showOther();
}, said, "-beside");

let askingOther = null;

// The budget beside is computed after that of the page.
function askOther() {
  clearTimeout(askingOther);
  if (!bench.other || bench.other.budget) return;
  if (!bench.budget || bench.stale) { askingOther = setTimeout(askOther, 500); return; }
  bench.other.count = 0;
  otherBudget.ask(bench.other.state);
}

function setOther(state, name, budget = null) {
  otherBudget.stop();
  bench.other = { state, name, budget, count: 0 };
  otherPicture.ask(state, state);
  otherFound.ask(state, state);
  askOther();
  showOther();
}

$("compare").addEventListener("click", () => {
  if (bench.other) {
    bench.other = null;
    otherBudget.stop();
    $("other").hidden = true;
  } else if (bench.camera) {
    setOther(structuredClone(bench.state), bench.camera.name, bench.stale ? null : bench.budget);
    $("other").hidden = false;
    $("other").scrollIntoView({ block: "nearest" });
  }
  $("compare").setAttribute("aria-pressed", String(Boolean(bench.other)));
  $("compare").textContent = bench.other ? "End comparing" : "Compare";
});

$("other-camera").addEventListener("change", () => {
  const name = $("other-camera").value;
  $("other-camera").value = "";
  const measured = structuredClone({ scenario: bench.state.scenario ?? {}, scene: bench.state.scene ?? null, estimator: bench.state.estimator });
  if (name) setOther({ camera: name, set: {}, ...measured, chosen: "" }, name);
});
$("swap").addEventListener("click", () => {
  const mine = structuredClone(bench.state), theirs = bench.other.state, name = bench.camera.name, budget = bench.stale ? null : bench.budget;
  begin(theirs);
  setOther(mine, name, budget);
});

function showOther() {
  const o = bench.other;
  if (!o) return;
  $("other-title").textContent = `Beside it: ${o.name}`;
  const figure = el("figure");
  if (o.picture) {
    const made = screen(o.picture, `The target in ${o.name}; ${errorText(o.found)}`);
    drawFound(made.over, o.picture, o.found);
    figure.append(made.box, el("figcaption", {}, el("b", {}, o.name), " ", errorText(o.found)));
  }
  const mine = bench.stale ? null : bench.budget, theirs = o.budget;
  const words = o.problem ?? (theirs ? (mine ? compared(mine, theirs) : "The budget of the camera above is being computed.") : `The budget of ${o.name} follows that of the camera above: ${o.count} sources so far.`);
  const body = el("tbody");
  const line = (title, values, shown) => body.append(el("tr", {}, el("th", { scope: "row" }, title), ...values.map((v) => el("td", { class: "n" }, v === undefined ? "…" : shown(v)))));
  for (const [title, key] of [["before calibration", "before"], ["after calibration", "after"], ["only what is known", "least"], ["the rest at its bound", "most"]]) line(title, [mine, theirs].map((b) => b?.rms_px[key]), px);
  if (mine && theirs) {
    body.append(el("tr", {}, el("th", { scope: "row", colspan: 3 }, "The sources that make the difference, after calibration")));
    for (const r of apart(mine, theirs)) line(r.title, r.px, (v) => (v === null ? "–" : mpx(v)));
  }
  const heading = el("tr", {}, ["", `above: ${bench.camera?.name ?? ""}`, `beside: ${o.name}`].map((t) => el("th", { scope: "col" }, t)));
  $("other-body").replaceChildren(el("p", { id: "better" }, el("b", {}, words)), el("div", { class: "side" }, figure, el("div", { class: "scroll" }, el("table", {}, el("caption", {}, "One target in one frame, k = 1, rms of x and y"), el("thead", {}, heading), body))));
}

// The sources whose errors differ most; null where a camera has none of it.
function apart(mine, theirs) {
  const rows = new Map();
  for (const [k, b] of [[0, mine], [1, theirs]]) for (const r of b.rows) if (counted(r)) {
    if (!rows.has(r.name)) rows.set(r.name, { title: r.title, px: [null, null] });
    rows.get(r.name).px[k] = r.after_px;
  }
  const far = (r) => Math.abs((r.px[0] ?? 0) ** 2 - (r.px[1] ?? 0) ** 2);
  return [...rows.values()].filter((r) => r.px[0] !== r.px[1]).sort((a, b) => far(b) - far(a)).slice(0, 8);
}

function compared(mine, theirs) {
  const [a, b] = [mine, theirs].map((x) => x.rms_px.after);
  if (Math.abs(a - b) < 0.01 * Math.max(a, b)) return "Both are alike.";
  const names = bench.camera.name === bench.other.name ? ["The one above", "The one beside"] : [bench.camera.name, bench.other.name];
  return `${names[a < b ? 0 : 1]} is better here: ${px(Math.min(a, b))} against ${px(Math.max(a, b))}.`;
}

$("camera").addEventListener("change", () => begin({ camera: $("camera").value, scene: bench.state.scene, scenario: bench.state.scenario, estimator: bench.state.estimator, chosen: bench.state.chosen }));
$("estimator").addEventListener("change", () => { bench.state.estimator = $("estimator").value; changed(); });
$("reset").addEventListener("click", () => { bench.state = { camera: bench.state.camera, record: bench.state.record, scene: bench.state.scene, chosen: bench.state.chosen, set: {}, scenario: {} }; showState(); });
$("side").addEventListener("change", () => { bench.state.side_px = Number($("side").value); changed(); });
for (const which of ["before", "after"]) $(which).addEventListener("click", () => {
  bench.before = which === "before";
  for (const id of ["before", "after"]) $(id).setAttribute("aria-pressed", String(id === which));
  showNumbers();
});
window.addEventListener("hashchange", () => { try { begin(unpacked(location.hash.slice(1))); } catch { said("the link does not hold a state"); } });

const opening = await (await fetch("opening")).json();
bench.catalogue = opening.catalogue;
bench.cameras = opening.cameras;
bench.first = opening.state.camera ?? "pulnix_tm6cn_epix_512";
// For tests: open a state and wait for its controls; undo one value.
bench.open = async (state) => {
  begin(state);
  const there = () => bench.camera && bench.panel === panelMark() && !pictures.busy && !cameras.busy;
  while (!there() && !$("said").textContent) await new Promise((done) => setTimeout(done, 10));
};
bench.forget = (key) => { delete bench.state.set[key]; changed(); };

fillChoices();
makeViews(bench, (values) => {
  bench.state.scenario = { ...bench.state.scenario, state: { ...(bench.state.scenario?.state ?? {}), ...values } };
  bench.redrawScenario = true;
  changed();
});
let start = opening.state;
if (location.hash.length > 1) try { start = unpacked(location.hash.slice(1)); } catch { said("the link does not hold a state"); }
begin({ chosen: "grabber.low_pass", ...start });
