// The page: tabs, filters, the contact sheet, the viewer, the player, keys.

const by = (id) => document.getElementById(id);
const state = { tab: "", row: -1, episode: -1, step: 0, place: 0, walking: false, spinning: false,
  playing: false, marked: true, photo: true, strands: true, masks: false, speed: 1, camera: topView(), filmCamera: topView() };

// use textContent only, so that nothing in a file can become markup
function made(kind, text = "", properties = {}) {
  const element = document.createElement(kind);
  element.textContent = text;
  return Object.assign(element, properties);
}

function facts(list, rows) {
  list.replaceChildren(...rows.filter(([, value]) => value !== "" && value != null).flatMap(([name, value]) => {
    const cell = made("dd");
    cell.append(value instanceof Node ? value : String(value));
    return [made("dt", name), cell];
  }));
}

// show JSON in a collapsible box, other text as it is
function unfolding(text) {
  if (!text.startsWith("{")) return text;
  let whole = text;
  try {
    whole = JSON.stringify(JSON.parse(text), null, 1);
  } catch { /* the JSON was cut */ }
  const box = made("details");
  box.append(made("summary", "show"), made("pre", whole));
  return box;
}

function tool(box, text, act, pressed) {
  const button = made("button", text, { type: "button", onclick: act });
  if (pressed !== undefined) button.setAttribute("aria-pressed", pressed);
  box.append(button);
  return button;
}

// ---- filters: toggle buttons for each value of a field; none pressed means all

function chips(form, rows, name, field, order) {
  const counts = new Map();
  for (const row of rows) counts.set(field(row), (counts.get(field(row)) || 0) + 1);
  const pressed = new Set();
  if (counts.size < 2) return () => true;
  const set = made("fieldset"), box = made("div", "", { className: "chips" });
  set.append(made("legend", name), box);
  for (const value of [...counts.keys()].sort(order)) {
    const button = tool(box, String(value), () => {
      pressed.has(value) ? pressed.delete(value) : pressed.add(value);
      button.setAttribute("aria-pressed", pressed.has(value));
      form.onfilter();
    }, false);
    button.dataset.filter = name;
    button.dataset.value = String(value);
    button.append(made("small", String(counts.get(value))));
  }
  form.append(set);
  return (row) => !pressed.size || pressed.has(field(row));
}

function search(form, name, text) {
  const box = made("label"), input = made("input", "", { type: "search", placeholder: "1+,1-", size: 16 });
  input.dataset.filter = name;
  box.append(made("span", name), input);
  form.append(box);
  input.addEventListener("input", () => form.onfilter());
  return (row) => text(row).includes(input.value.trim().replaceAll(" ", ""));
}

// a quality measure chosen from a list: filters by a range and sorts
function measure(form, rows) {
  if (!DATA.measures.length) return { keeps: () => true, order: () => 0 };
  const box = made("div", "", { className: "measure" }), select = made("select"), canvas = made("canvas");
  const picked = made("label"), ends = made("div", "", { className: "ends" }), says = made("output");
  select.append(made("option", "any, in file order", { value: "" }));
  DATA.measures.forEach(({ name }, k) => select.append(made("option", name.replaceAll("_", " "), { value: k })));
  const inputs = [0, 1000].map((value, k) =>
    made("input", "", { type: "range", min: 0, max: 1000, value, ariaLabel: k ? "at most" : "at least" }));
  select.dataset.filter = "measure";
  picked.append(made("span", "filter and sort by"), select);
  ends.append(...inputs);
  box.append(picked, canvas, says, ends);
  form.append(box);
  const of = (row) => row.q[Number(select.value)];
  const range = () => {
    const values = rows.map(of).filter(Number.isFinite), low = Math.min(...values), span = Math.max(...values) - low;
    const at = inputs.map((input) => low + (span * Number(input.value)) / 1000);
    const slack = 1e-9 * (1 + span);
    return { values, low: Math.min(...at) - slack, high: Math.max(...at) + slack };
  };
  const changed = () => {
    const chosen = select.value !== "";
    for (const part of [canvas, ends, says]) part.hidden = !chosen;
    if (chosen) {
      const { values, low, high } = range();
      drawHistogram(canvas, values, low, high);
      says.textContent = `${shortened(low)} – ${shortened(high)} ${DATA.measures[Number(select.value)].unit}`;
    }
    form.onfilter();
  };
  select.addEventListener("change", () => {
    inputs[0].value = 0;
    inputs[1].value = 1000;
    changed();
  });
  inputs.forEach((input) => input.addEventListener("input", changed));
  for (const part of [canvas, ends, says]) part.hidden = true;
  return {
    keeps() {
      if (select.value === "") return () => true;
      const { low, high } = range();
      return (row) => of(row) >= low && of(row) <= high;
    },
    order: (a, b) => (select.value === "" ? 0 : of(a) - of(b)),
  };
}

const shortened = (x) => (Number.isFinite(x) ? String(Number(x.toPrecision(3))) : "–");
const byNumber = (a, b) => a - b;
const byDifficulty = (a, b) => DATA.grades.indexOf(a) - DATA.grades.indexOf(b);

function handOf(row) {
  const signs = new Set(row.x.map((crossing) => crossing[2]));
  return !signs.size ? "none" : signs.size > 1 ? "mixed" : signs.has(1) ? "c" : "a";
}

// ---- states

const states = DATA.states;
let order = states;

function thumbnail(canvas, points) {
  const pen = fitted(canvas);
  const camera = { ...topView(), side: sideOf(points) };
  drawRope(pen, points, projection(camera, canvas.clientWidth, canvas.clientHeight), false);
}

const visible = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries)
    if (isIntersecting) {
      thumbnail(target, states[target.dataset.row].points);
      visible.unobserve(target);
    }
}, { rootMargin: "300px" });

function card(row, index) {
  const button = made("button", "", { type: "button", className: "card", onclick: () => openState(index, true) });
  const says = made("div"), line = made("span"), dot = made("i");
  dot.style.background = colourOf(row.nx);
  line.append(dot, `nx ${row.nx}  ${row.split}  #${row.row}`);
  const code = made("b", "", { title: row.code || "loop" });
  for (const visit of row.code ? row.code.split(/(?<=,)/) : ["loop"]) code.append(made("span", visit), made("wbr"));
  says.append(code, line);
  const shown = row.image ? made("img", "", { src: row.image, alt: "", loading: "lazy" }) : made("canvas");
  shown.dataset.row = index;
  button.append(shown, says);
  if (!row.image) visible.observe(shown);
  return button;
}

function startStates() {
  const bytes = decoded(DATA.points), size = 3 * DATA.beads;
  states.forEach((row, i) => (row.points = bytes.subarray(i * size, (i + 1) * size)));
  const cards = new Map(states.map((row, i) => [row, card(row, i)])), form = by("filters");
  form.onsubmit = (event) => event.preventDefault();
  const tests = [
    chips(form, states, "nx", (row) => row.nx, byNumber),
    chips(form, states, "split", (row) => row.split),
    chips(form, states, "chirality", handOf),
    ...DATA.words.map((name) => chips(form, states, name, (row) => row[name], byDifficulty)),
    search(form, "code", (row) => `${row.plain} ${row.code}`),
  ];
  const chosen = measure(form, states);
  form.onfilter = () => {
    const keeps = [...tests, chosen.keeps()];
    order = states.filter((row) => keeps.every((keep) => keep(row))).sort(chosen.order);
    by("sheet").replaceChildren(...order.map((row) => cards.get(row)));
    by("shown").textContent = `${order.length} of ${states.length} ${DATA.called}`;
  };
  form.onfilter();
  turnable(by("stage"), state.camera, showState);
  by("place").max = DATA.beads;
  by("place").oninput = () => {
    Object.assign(state, { place: Number(by("place").value), walking: false });
    showState();
  };
  by("close").onclick = () => closeState();
  const tools = by("state-tools");
  tool(tools, "Walk", () => keys[" "](), false).id = "walk";
  tool(tools, "Spin", () => keys.s(), false).id = "spin";
  tool(tools, "Top view", () => keys.t());
  tool(tools, "Crossings", () => keys.c(), true).id = "mark";
  if (!states.some((row) => row.image)) return;
  tool(tools, "Picture", () => keys.p(), true).id = "photo";
  if (!states.some((row) => row.masks)) return;
  tool(tools, "Strands", () => keys.l(), true).id = "strands";
  tool(tools, "Masks", () => keys.m(), false).id = "masks";
}

function openState(index, byHand) {
  Object.assign(state, { row: index, place: 0, walking: false });
  const row = states[index];
  Object.assign(state.camera, topView(), { side: sideOf(row.points) });
  by("viewer").hidden = false;
  for (const shown of document.querySelectorAll("[data-row]")) {
    const current = shown.dataset.row === String(index);
    shown.parentElement.setAttribute("aria-current", current);
    if (current && !byHand) shown.scrollIntoView({ block: "nearest" });
  }
  by("state-name").textContent = `${row.image ? "Picture" : "State"} ${row.row}, ${row.nx} ${row.nx === 1 ? "crossing" : "crossings"}`;
  by("state-code").replaceChildren(...chipsOf(row.x));
  const measures = DATA.measures.map(({ name, unit }, k) => {
    const values = states.map((other) => other.q[k]).filter(Number.isFinite), cell = made("span");
    const below = values.filter((value) => value < row.q[k]).length / Math.max(1, values.length - 1);
    cell.append(made("meter", "", { min: 0, max: 1, value: Math.min(1, below), title: "rank among all states" }),
      `${shortened(row.q[k])} ${unit}`);
    return [name.replaceAll("_", " "), cell];
  });
  const at = DATA.episodes.findIndex((one) => one.set === row.set && one.number === row.trajectory);
  let way = "";
  if (at >= 0) way = made("button", "play", { type: "button", onclick: () => openEpisode(at) });
  facts(by("state-facts"), [["code", row.code || "loop"], ["split", row.split], ["knot", row.knot],
    ...DATA.words.map((name) => [name, row[name]]), ["actions to reach it", row.steps], ["demonstration", way], ...measures]);
  remember(`states/${row.row}`);
  showState();
}

function closeState() {
  by("viewer").hidden = window.innerWidth <= 860;
  state.walking = false;
}

function chipsOf(crossings) {
  const visits = visitsOf(crossings);
  if (!visits.length) return [made("span", "plain loop")];
  return visits.map(({ label, over, sign }) =>
    made("span", `${label}${over ? "+" : "-"}${sign > 0 ? "c" : "a"}`, { className: sign > 0 ? "c" : "a" }));
}

function showState() {
  if (state.row < 0 || state.tab !== "states" || by("viewer").hidden) return;
  const canvas = by("stage"), row = states[state.row], pen = fitted(canvas);
  const [wide, high] = [canvas.clientWidth, canvas.clientHeight], see = projection(state.camera, wide, high);
  const visits = visitsOf(row.x), walking = state.walking || state.place > 0;
  let lit = -1;
  visits.forEach((visit, k) => {
    if (walking && visit.place <= state.place) lit = k;
  });
  if (row.image && state.photo) drawPicture(pen, row, Math.min(wide, high));
  else drawRope(pen, row.points, see, true);
  if (row.image && state.photo) { /* its labels are drawn with it */ }
  else if (state.marked) drawCrossings(pen, row.points, row.x, see, lit < 0 ? 0 : visits[lit].label);
  if (walking && !(row.image && state.photo)) drawMarker(pen, row.points, Math.min(state.place, DATA.beads - 1e-3), see);
  [...by("state-code").children].forEach((chip, k) => {
    chip.classList.toggle("passed", k <= lit);
    chip.classList.toggle("lit", k === lit);
  });
  by("place").value = state.place;
  for (const [id, on] of [["walk", state.walking], ["spin", state.spinning], ["mark", state.marked],
    ["photo", state.photo], ["strands", state.strands], ["masks", state.masks]])
    if (by(id)) by(id).setAttribute("aria-pressed", on);
}

// ---- pictures, with the labels that their table has

const images = new Map();

function loaded(source) {
  if (!images.has(source)) images.set(source, made("img", "", { onload: () => showState(), src: source }));
  const image = images.get(source);
  return image.complete && image.naturalWidth ? image : null;
}

// the strands' pixels, which hold their numbers, in colours
function tinted(row) {
  const image = loaded(row.masks);
  if (!image || row.tinted) return row.tinted;
  const canvas = made("canvas", "", { width: image.naturalWidth, height: image.naturalHeight });
  const pen = canvas.getContext("2d");
  pen.drawImage(image, 0, 0);
  const pixels = pen.getImageData(0, 0, canvas.width, canvas.height);
  for (let at = 0; at < pixels.data.length; at += 4) {
    const strand = pixels.data[at], colour = colourOf(strand);
    for (let k = 0; k < 3; k += 1) pixels.data[at + k] = parseInt(colour.slice(1 + 2 * k, 3 + 2 * k), 16);
    pixels.data[at + 3] = strand ? 170 : 0;
  }
  pen.putImageData(pixels, 0, 0);
  row.tinted = canvas;
  return canvas;
}

function drawPicture(pen, row, side) {
  const image = loaded(row.image);
  if (!image) return;
  const scale = side / image.naturalWidth;
  pen.drawImage(image, 0, 0, side, side);
  const masks = state.masks && row.masks ? tinted(row) : null;
  if (masks) pen.drawImage(masks, 0, 0, side, side);
  if (state.strands && row.line) drawLine(pen, row, scale);
  if (state.marked) visitsOf(row.x).filter((visit) => visit.over).forEach(({ label, sign }) => {
    const [x, y] = row.at[label - 1].map((value) => value * scale);
    pen.beginPath();
    pen.arc(x, y, 11, 0, 2 * Math.PI);
    pen.lineWidth = 2;
    pen.strokeStyle = sign > 0 ? "#0a7" : "#d35";
    pen.stroke();
    pen.font = "bold 13px sans-serif";
    pen.lineWidth = 3;
    pen.strokeStyle = "#fff";
    pen.strokeText(label, x + 12, y - 8);
    pen.fillStyle = "#111";
    pen.fillText(label, x + 12, y - 8);
  });
}

// the rope's middle, a colour for each piece between two visits of crossings
function drawLine(pen, row, scale) {
  const places = visitsOf(row.x).map((visit) => visit.place), count = row.line.length / 2;
  pen.lineWidth = 2;
  for (let k = 0; k < count; k += 1) {
    const next = (k + 1) % count, passed = places.filter((place) => place <= k + 0.5).length;
    pen.beginPath();
    pen.moveTo(row.line[2 * k] * scale, row.line[2 * k + 1] * scale);
    pen.lineTo(row.line[2 * next] * scale, row.line[2 * next + 1] * scale);
    pen.strokeStyle = colourOf(1 + (passed % Math.max(1, places.length)));
    pen.stroke();
  }
}

// ---- episodes

let listed = [];

const outcomeOf = (success) => (success ? "reached" : "failed");

function unpacked(episode) {
  if (episode.frames) return episode;
  episode.frames = decoded(episode.points);
  episode.goalFrame = decoded(episode.goal_points);
  return episode;
}

function startEpisodes() {
  const form = by("episode-filters"), rows = DATA.episodes;
  form.onsubmit = (event) => event.preventDefault();
  const items = new Map(rows.map((episode, k) => {
    episode.nx = episode.code.map((code) => (episode.codes[code] ? episode.codes[code].split(",").length / 2 : 0));
    const button = made("button", "", { type: "button", className: "row", onclick: () => openEpisode(k) });
    const won = made("em", outcomeOf(episode.success), { className: episode.success ? "" : "no" });
    const steps = `${episode.code.length - 1} steps`;
    button.append(made("b", episode.goal || "loop"), won,
      made("small", `${episode.name}  #${episode.number}  ${steps}  ${episode.policy}`));
    return [episode, button];
  }));
  const tests = [
    chips(form, rows, "nx", (episode) => (episode.goal ? episode.goal.split(",").length / 2 : 0), byNumber),
    chips(form, rows, "split", (episode) => episode.split),
    chips(form, rows, "goal", (episode) => outcomeOf(episode.success)),
    chips(form, rows, "policy", (episode) => episode.policy),
    search(form, "goal's code", (episode) => episode.goal),
  ];
  form.onfilter = () => {
    listed = rows.filter((episode) => tests.every((keep) => keep(episode)));
    by("episode-list").replaceChildren(...listed.map((episode) => items.get(episode)));
  };
  form.onfilter();
  for (const id of ["film", "goal"]) turnable(by(id), state.filmCamera, showEpisode);
  const time = by("time");
  const scrub = (event) => {
    state.playing = false;
    goTo(Math.round(stepAt(time, rows[state.episode], event.clientX)));
  };
  time.addEventListener("pointerdown", (event) => {
    try { time.setPointerCapture(event.pointerId); } catch { /* synthetic events have no pointer to capture */ }
    scrub(event);
  });
  time.addEventListener("pointermove", (event) => event.buttons && scrub(event));
  const tools = by("episode-tools");
  tool(tools, "Play", () => keys[" "](), false).id = "play";
  tool(tools, "◀ Step", () => keys.ArrowLeft());
  tool(tools, "Step ▶", () => keys.ArrowRight());
  const speed = tool(tools, "1 ×", () => {
    state.speed = { 1: 2, 2: 4, 4: 0.5, 0.5: 1 }[state.speed];
    speed.textContent = `${state.speed} ×`;
  });
  tool(tools, "Top view", () => keys.t());
  tool(tools, "Crossings", () => keys.c(), true).id = "film-mark";
}

function openEpisode(index) {
  choose(index);
  openTab("episodes");
}

function choose(index) {
  Object.assign(state, { episode: index, step: 0, playing: false });
  const episode = unpacked(DATA.episodes[index]);
  [...by("episode-list").children].forEach((row, k) => {
    row.setAttribute("aria-current", listed[k] === episode);
    if (listed[k] === episode) row.scrollIntoView({ block: "nearest" });
  });
  state.filmCamera.side = sideOf(episode.frames, episode.goalFrame);
  by("episode-name").textContent = `${episode.name}, episode ${episode.number}`;
  by("goal-code").replaceChildren(made("span", "goal"), ...spelt(episode.goal));
}

const spelt = (code) => (code ? code.split(",") : ["plain loop"]).map((visit) =>
  made("span", visit, { className: /[ac]$/.test(visit) ? visit.slice(-1) : "" }));

function goTo(step) {
  const last = DATA.episodes[state.episode].code.length - 1;
  state.step = Math.min(last, Math.max(0, step));
  showEpisode();
}

function showEpisode() {
  if (state.episode < 0 || state.tab !== "episodes") return;
  const episode = DATA.episodes[state.episode], size = 3 * DATA.beads, now = Math.floor(state.step);
  const last = episode.code.length - 1, part = state.step - now;
  const frame = episode.frames.slice(now * size, (now + 1) * size);
  if (part && now < last) // linear interpolation between two states
    for (let i = 0; i < size; i++) frame[i] += part * (episode.frames[(now + 1) * size + i] - frame[i]);
  const draw = (id, points, crossings, after) => {
    const canvas = by(id), pen = fitted(canvas), [wide, high] = [canvas.clientWidth, canvas.clientHeight];
    const see = projection(state.filmCamera, wide, high);
    drawRope(pen, points, see, true);
    if (state.marked && crossings) drawCrossings(pen, points, crossings, see, 0);
    if (after) after(pen, see);
  };
  const next = now + 1, strength = next <= last ? Math.hypot(...episode.force[next]) : 0;
  const share = next <= last ? episode.applied_share[next] : 1;
  draw("film", frame, part ? null : episode.x[now], (pen, see) => {
    if (strength) drawPull(pen, frame, episode.bead[next], episode.force[next], see);
    if (now === last) drawOutcome(pen, episode.success);
  });
  draw("goal", episode.goalFrame, episode.goal_x);
  drawTimeLine(by("time"), episode, state.step);
  const code = episode.codes[episode.code[now]], total = episode.rewards.slice(0, now).reduce((a, b) => a + b, 0);
  by("film-code").replaceChildren(...spelt(episode.chiral[episode.code_chiral[now]]));
  facts(by("episode-facts"), [
    ["step", `${now} of ${last}`],
    ["code", (code || "loop") + (code === episode.goal ? ", the goal's" : "")],
    ["pull", strength ? `bead ${episode.bead[next]}, ${shortened(strength)} N` + (share < 1 ? `, reduced to ${100 * share} %` : "")
      : share < 1 ? "none: it would have pulled the rope apart" : next <= last ? "none, the rope settles" : "none, the episode ended"],
    ["reward", now ? `${shortened(episode.rewards[now - 1])}, ${shortened(total)} so far` : "0"],
    ["policy", episode.policy], ["split", episode.split], ["seed", episode.seed], ["dataset", episode.set],
  ]);
  by("play").setAttribute("aria-pressed", state.playing);
  by("play").textContent = state.playing ? "Stop" : "Play";
  by("film-mark").setAttribute("aria-pressed", state.marked);
}

// ---- tabs, time, keys

function openTab(name) {
  state.tab = name;
  for (const id of ["states", "episodes", "run"]) by(`tab-${id}`).hidden = id !== name;
  [...by("tabs").children].forEach((tab) => tab.setAttribute("aria-selected", tab.dataset.tab === name));
  show();
  if (name === "episodes" && state.episode >= 0) remember(`episodes/${state.episode}`);
  else remember(state.row >= 0 && name === "states" ? `states/${states[state.row].row}` : name);
}

function remember(place) {
  history.replaceState(null, "", `#${place}`);
}

function show() {
  if (state.tab === "states") showState();
  if (state.tab === "episodes") showEpisode();
  if (state.tab === "run" && Object.keys(DATA.rejected).length) drawRejected(by("rejected"), DATA.rejected);
}

let before = 0;
function tick(time) {
  const passed = Math.min(0.1, (time - before) / 1000);
  before = time;
  if (state.tab === "states" && (state.walking || state.spinning)) {
    if (state.walking) state.place += 12 * passed;
    if (state.place >= DATA.beads) Object.assign(state, { place: 0, walking: false });
    if (state.spinning) state.camera.turn += 0.7 * passed;
    showState();
  }
  if (state.tab === "episodes" && state.playing) {
    const last = DATA.episodes[state.episode].code.length - 1;
    state.step = Math.min(last, state.step + 4 * state.speed * passed);
    if (state.step === last) state.playing = false;
    showEpisode();
  }
  requestAnimationFrame(tick);
}

function nextState(way) {
  const at = order.indexOf(states[state.row]);
  if (order.length) openState(states.indexOf(order[(at + way + order.length) % order.length]), false);
}

function nextEpisode(way) {
  const at = listed.indexOf(DATA.episodes[state.episode]);
  if (listed.length) openEpisode(DATA.episodes.indexOf(listed[(at + way + listed.length) % listed.length]));
}

function step(way) {
  state.playing = false;
  goTo(way > 0 ? Math.floor(state.step) + 1 : Math.ceil(state.step) - 1);
}

const inStates = () => state.tab === "states";
const keys = {
  " "() {
    if (inStates()) state.walking = !state.walking;
    else if (state.tab === "episodes") {
      const last = DATA.episodes[state.episode].code.length - 1;
      if (!state.playing && state.step >= last) state.step = 0;
      state.playing = !state.playing;
    }
    show();
  },
  ArrowRight: () => (inStates() ? nextState(1) : state.tab === "episodes" && step(1)),
  ArrowLeft: () => (inStates() ? nextState(-1) : state.tab === "episodes" && step(-1)),
  ArrowDown: () => state.tab === "episodes" && nextEpisode(1),
  ArrowUp: () => state.tab === "episodes" && nextEpisode(-1),
  c() { state.marked = !state.marked; show(); },
  p() { state.photo = !state.photo; show(); },
  l() { state.strands = !state.strands; show(); },
  m() { state.masks = !state.masks; show(); },
  s() { state.spinning = !state.spinning; if (state.spinning && !state.camera.tilt) state.camera.tilt = 0.9; show(); },
  t() { state.spinning = false; Object.assign(inStates() ? state.camera : state.filmCamera, topView()); show(); },
  "?": () => by("help").showModal(),
  Escape: () => inStates() && closeState(),
};

document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
  const tabs = [...by("tabs").children], tab = tabs[Number(event.key) - 1];
  if (event.key === " " && event.target.matches("button")) return;
  if (tab) tab.click();
  else if (keys[event.key] && !by("help").open) {
    if (event.key.startsWith("Arrow") && (inStates() || state.tab === "episodes")) {
      if (inStates() && ["ArrowUp", "ArrowDown"].includes(event.key)) return;
      event.preventDefault();
    }
    if (event.key === " ") event.preventDefault();
    keys[event.key]();
  }
});

function start() {
  by("title").textContent = DATA.title;
  by("says").textContent = DATA.says;
  by("notices").hidden = !DATA.notices.length;
  by("notices").textContent = DATA.notices.join(" ");
  facts(by("about"), DATA.about.map(([name, value]) => [name, unfolding(value)]));
  by("rejected-box").hidden = !Object.keys(DATA.rejected).length;
  const has = [["states", DATA.called[0].toUpperCase() + DATA.called.slice(1), states.length], ["episodes", "Episodes", DATA.episodes.length], ["run", "Run", 1]];
  for (const [id, name, count] of has)
    if (count) {
      const tab = tool(by("tabs"), name, () => openTab(id));
      tab.setAttribute("role", "tab");
      tab.dataset.tab = id;
    }
  const [tab, row, at] = location.hash.slice(1).split("/");
  if (DATA.episodes.length) {
    startEpisodes();
    choose(tab === "episodes" && DATA.episodes[row] ? Number(row) : 0);
  }
  if (states.length) startStates();
  openTab(has.some(([id, , count]) => id === tab && count) ? tab : has.find((one) => one[2])[0]);
  if (state.tab === "episodes") goTo(Number(at) || 0);
  const named = state.tab === "states" && row ? states.findIndex((one) => one.row === Number(row)) : -1;
  if (state.tab === "states" && (named >= 0 || window.innerWidth > 860)) openState(Math.max(0, named), named < 0);
  if (window.innerWidth <= 860) for (const box of document.querySelectorAll("details")) box.open = false;
  window.addEventListener("resize", show);
  requestAnimationFrame(tick);
}

start();
