// The page keeps the files. Each request sends them with the options; the answer is one JSON message per line.
// The server keeps the messages of calibrations; the page keeps the name of the last one while it is loaded again.
"use strict";

const LIMIT = Number(document.documentElement.dataset.limit);
const MAX_FILES = Number(document.documentElement.dataset.files);
const ROLES = {
  robot: "Robot", data: "Measurements", images: "Photograph or video", rig: "Rig: camera and board", servos: "Servos",
  columns: "Column map", beside: "Sidecar or other",
};
// Uses of which there is one file: a new one replaces the other.
const SINGLE = ["robot", "columns", "rig", "servos"];
const ROBOT = /\.(urdf|dh\.toml|dh\.csv|ya?ml)$/i;
// Fewer photographs seldom determine an arm.
const MIN_PHOTOGRAPHS = 12;
const READING = "Reading the files …";
// Pause before the files are checked again after a change [ms].
const CHECK_DELAY = 300;

const files = new Map();  // name -> { file, role }
const mends = [];         // changes of the measurements that a refused calibration named
const links = [];         // addresses of results in memory
let checking = null, running = null, timer = 0;

const $ = id => document.getElementById(id);

// Creates an element with properties and children; texts are never interpreted as HTML.
function element(name, properties = {}, ...children) {
  const out = Object.assign(document.createElement(name), properties);
  out.append(...children.filter(child => child !== null));
  return out;
}

function list(texts) {
  return texts.length ? element("ul", {}, ...texts.map(text => element("li", {}, text))) : null;
}

// A wide table scrolls in a box that the keyboard can reach.
function table(caption, header, rows) {
  const cell = (name, text, scope) => element(name, scope ? { scope } : {}, text);
  return element("div", { className: "scroll", tabIndex: 0, role: "region", ariaLabel: caption },
    element("table", {}, element("caption", {}, caption),
      element("thead", {}, element("tr", {}, ...header.map(text => cell("th", text, "col")))),
      element("tbody", {}, ...rows.map(row => element("tr", {}, ...row.map((text, i) => cell(i ? "td" : "th", text, i ? "" : "row")))))));
}

function showError(id, text) {
  $(id).textContent = text;
  $(id).hidden = !text;
}

// Controls of the page by the options of the command line.
const CONTROLS = {
  "--skip-bad-rows": "“Skip rows that lack a number, a name or a rotation”", "--tip": "“Tip link”", "--columns": "a column map among the files",
  "--rig": "a rig file among the files", "--robot": "a robot among the files", "--servos": "a servo file among the files", "--parameters": "“Errors to estimate”", "--holdout": "“Judge the accuracy on”", "--sheet": "“Sheet of Excel files”", "--force": "“Write the robot all the same”",
  "--mend": "the applied change",
};

// A message of the command, in the words of the page.
function spoken(text) {
  return text.replace(/ \(--columns(?: MAP\.toml)?\)/g, "").replace(/(--[a-z-]+) (?:FILE|RIG\.toml)( \([^)]*\))?/g, "$1").replace(/, (or )?add --mend \S+(?:(?: or)? --mend \S+)*$/, ", $1press a button below.")
    .replace(/--[a-z][a-z-]*/g, option => CONTROLS[option] ?? `${option} of the command line`);
}

const megabytes = bytes => bytes < 1e5 ? `${Math.max(1, Math.round(bytes / 1e3))} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
const named = role => [...files].filter(([, entry]) => entry.role === role).map(([name]) => name);

// --- files -----------------------------------------------------------------------------------------

async function roleOf(file) {
  const { name } = file;
  if (/\.(calibration\.toml|stl|dae|obj|mtl|glb|zip|pdf|docx?|md|html?)$/i.test(name)) return "beside";
  if (ROBOT.test(name)) return "robot";
  if (/\.json$/i.test(name)) return "servos";
  if (/\.(png|jpe?g|bmp|tiff?|webp|mp4|mov|avi|mkv|webm)$/i.test(name)) return "images";
  if (!/\.toml$/i.test(name)) return "data";
  const text = await file.text();
  return /^\s*\[\s*(camera|board)\b/m.test(text) ? "rig" : /^\s*(\[\s*motor\b|lerobot\s*=)/m.test(text) ? "servos" : "columns";
}

function setRole(name, role) {
  if (SINGLE.includes(role)) {
    for (const [other, entry] of files) if (other !== name && entry.role === role) {
      files.delete(other);
      showError("file-error", `${name} takes the place of ${other}, which is removed from the list.`);
    }
  }
  files.get(name).role = role;
}

// The use of a file follows from its name and content, or is given.
async function addFiles(added, role = null, isMade = false) {
  added = [...added];
  const total = [...files.values()].reduce((sum, { file }) => sum + file.size, 0);
  const size = added.reduce((sum, file) => sum + file.size, total);
  if (files.size + added.length > MAX_FILES) {
    showError("file-error", document.documentElement.dataset.tooMany);
    return;
  }
  if (size > LIMIT) {
    showError("file-error", `The files have ${megabytes(size)}; at most ${megabytes(LIMIT)} are accepted (dhcal app --max-size).`);
    return;
  }
  showError("file-error", "");
  const roles = await Promise.all(added.map(file => role ?? roleOf(file)));
  added.forEach((file, i) => {
    files.set(file.name, { file, role: "beside", isMade });
    setRole(file.name, roles[i]);
  });
  filesChanged();
  await showPhotographSize(added);
}

function filesChanged() {
  mends.length = 0;
  clearResult();
  showMends();
  showFiles();
  showLinks();
  showHoldoutFiles();
  // Images have errors of their own, and all of them are needed.
  const hasRig = named("rig").length > 0;
  if (hasRig && !$("parameters").disabled) $("holdout").value = $("parameters").value = "";
  $("parameters").disabled = hasRig;
  $("sheet-field").hidden = named("images").length > 0 || !named("data").some(name => /\.xls[xm]$/i.test(name));
  if (named("images").length) $("rig-maker").open = !hasRig;
  $("parameters").options[0].text = hasRig ? "Arm, camera, board, lens" : "Joint origins, base, tool (default)";
  check();
}

function showFiles() {
  const images = named("images"), others = [...files].filter(([, { role }]) => role !== "images");
  const rest = images.length ? [photographsItem(images)] : [];
  sessionStorage.files = [...(images.length ? [count(images.length, "photograph")] : []), ...others.map(([name]) => name)].join(", ");
  $("files").replaceChildren(...rest, ...others.map(([name, { file, role }]) => {
    const use = element("select", { ariaLabel: `Use of ${name}` },
      ...Object.entries(ROLES).map(([value, text]) => element("option", { value, selected: value === role }, text)));
    use.onchange = () => { setRole(name, use.value); filesChanged(); };
    const remove = element("button", { type: "button", ariaLabel: `Remove ${name}` }, "Remove");
    remove.onclick = () => { files.delete(name); filesChanged(); $("picker").focus(); };
    return element("li", {}, element("span", { className: "name" }, name),
      element("span", { className: "size" }, megabytes(file.size)), use, remove);
  }));
}

// All photographs are one entry of the list.
function photographsItem(names) {
  const size = names.reduce((sum, name) => sum + files.get(name).file.size, 0);
  const remove = element("button", { type: "button", ariaLabel: "Remove all photographs" }, "Remove");
  remove.onclick = () => { for (const name of names) files.delete(name); filesChanged(); $("picker").focus(); };
  return element("li", {}, element("span", { className: "name" }, count(names.length, "photograph")),
    element("span", { className: "size" }, megabytes(size)), remove);
}

// Suggests the links of the URDF as tip.
async function showLinks() {
  const [robot] = named("robot");
  $("tip").disabled = !!robot && !/\.urdf$/i.test(robot);
  let names = [];
  if (robot && !$("tip").disabled) {
    const text = await files.get(robot).file.text();
    const xml = new DOMParser().parseFromString(text, "application/xml");
    names = [...xml.querySelectorAll("robot > link")].map(link => link.getAttribute("name")).filter(Boolean);
  }
  $("links").replaceChildren(...names.map(value => element("option", { value })));
}

// A measurement file can be the hold-out if another one is left for the fit.
function showHoldoutFiles() {
  const before = $("holdout").value, data = named("data");
  for (const option of $("holdout").querySelectorAll("option[data-file]")) option.remove();
  if (data.length > 1) {
    $("holdout").append(...data.map(value => {
      const option = element("option", { value }, `the file ${value}, not fitted`);
      option.dataset.file = "";
      return option;
    }));
  }
  $("holdout").value = before;
  if ($("holdout").selectedIndex < 0) $("holdout").selectedIndex = 0;
}

// --- rig file and board ----------------------------------------------------------------------------

function writeRig() {
  const wrong = [...document.querySelectorAll("#rig-fields input")].find(field => !field.checkValidity());
  showError("rig-error", wrong ? `${wrong.labels[0].textContent}: expected a positive number.` : "");
  $("rig-status").textContent = "";
  if (wrong) return;
  const place = $("rig-place").value, square = $("rig-square").value;
  $("rig-text").value = `[camera.webcam]
link = "${place}"
width = ${$("rig-width").value}
height = ${$("rig-height").value}

[board.paper]
link = "${place === "tip" ? "world" : "tip"}"
type = "charuco"
columns = 8
rows = 5
square_mm = ${square}
marker_mm = ${Number((22 / 30 * square).toFixed(2))}
dictionary = "DICT_5X5_100"
${$("rig-ruler").value ? `ruler_mm = ${$("rig-ruler").value}\n` : ""}`;
}

// The fields no longer describe a text that was edited.
function rigEdited() {
  $("rig-fields").disabled = $("rig-text").value.trim() !== "";
  if (!$("rig-fields").disabled) writeRig();
}

const rigFile = () => new File([$("rig-text").value], "rig.toml", { type: "text/plain" });

// The size of the photographs is that of the first one.
async function showPhotographSize(added) {
  const photograph = added.find(({ name }) => files.get(name)?.role === "images");
  if ($("rig-fields").disabled || named("rig").length) return;
  try {
    const { width, height } = await createImageBitmap(photograph);
    [$("rig-width").value, $("rig-height").value] = [width, height];
    writeRig();
  } catch {
    // There is none, or it is a video.
  }
}

async function printBoard(paper) {
  const body = new FormData();
  body.append("request", JSON.stringify({ rig: "rig.toml", paper }));
  body.append("file", rigFile());
  const buttons = document.querySelectorAll("[data-paper]");
  $("rig-status").textContent = "";
  showError("rig-error", "");
  for (const button of buttons) button.disabled = true;
  try {
    await send("board", body, null, message => {
      if (message.error) throw new Error(spoken(message.error));
      downloadItem(message.files[0]).querySelector("a").click();
      $("rig-status").textContent = "board.pdf is saved. Print it at 100 %, without fitting to the page. Measure its ruler line, enter its length above, and use the rig file.";
    });
  } catch (error) {
    showError("rig-error", failure(error));
  }
  for (const button of buttons) button.disabled = false;
}

// --- requests --------------------------------------------------------------------------------------

function form(request) {
  const out = new FormData();
  const options = {
    tip: $("tip").disabled ? "" : $("tip").value.trim(), sheet: $("sheet-field").hidden ? "" : $("sheet").value.trim(), images: named("images"),
  };
  for (const role of SINGLE) options[role] = named(role)[0] ?? "";
  out.append("request", JSON.stringify({ ...options, ...request }));
  for (const [name, { file }] of files) out.append("file", file, name);
  return out;
}

// Sends the files, or follows a job without any, and passes each message of the answer on.
async function send(operation, body, signal, onMessage) {
  const response = await fetch(operation, { method: body ? "POST" : "GET", body, signal });
  if (!response.ok) throw new Error((await response.text()).trim());
  if (operation === "calibrate") sessionStorage.job = response.headers.get("Job") ?? "";
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "", last = {};
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    const lines = (rest + value).split("\n");
    rest = lines.pop();
    for (const line of lines) onMessage(last = JSON.parse(line));
  }
  if (!last.error && !last.result) throw new Error("the answer is incomplete; try again");
}

function failure(error) {
  return error instanceof TypeError ? "The server does not answer; start dhcal app again." : error.message;
}

// --- check -----------------------------------------------------------------------------------------

function updateButtons() {
  const hasImages = named("images").length > 0, measured = hasImages ? "a table with a column image and the values or counts of each joint, such as shoulder_pan[ticks]" : "measurements";
  const missing = [...(named("robot").length ? [] : ["a robot"]), ...(named("data").length ? [] : [measured]),
    ...(hasImages && !named("rig").length ? ["a rig file with camera and board"] : [])];
  $("cancel").hidden = $("progress").hidden = !running;
  for (const button of document.querySelectorAll("#calibrate, #result .buttons button")) button.disabled = !!running || missing.length > 0;
  $("needed").textContent = running || !missing.length ? "" : `Add ${missing.join(" and ")}.`;
}

function check() {
  clearTimeout(timer);
  checking?.abort();
  showNeeds([]);
  updateButtons();
  if (!named("data").length && !named("images").length) {
    $("check").replaceChildren(element("p", { className: "hint" }, "The content of the files is shown here."));
    return;
  }
  timer = setTimeout(inspect, CHECK_DELAY);
}

async function inspect() {
  const controller = checking = new AbortController();
  $("check").replaceChildren(element("p", { className: "hint" }, READING));
  const cards = [];
  const show = ({ boards, notes, error, result }) => {
    if (controller.signal.aborted) return;
    if (boards) cards.push(...boards.map(boardCard), ...notes.map(text => element("p", { className: "card warning" }, spoken(text))));
    else if (error) cards.push(element("p", { className: "error" }, spoken(error)));
    else cards.push(...result.files.map(fileCard));
    $("check").replaceChildren(...cards, ...(boards ? [element("p", { className: "hint" }, READING)] : []));
    $("tip").placeholder = result?.robot?.tip ?? "last link of the chain";
    showNeeds([error ?? "", ...(result?.files.map(file => file.problem) ?? [])]);
  };
  try {
    await send("inspect", form({ data: named("data") }), controller.signal, show);
  } catch (error) {
    if (error.name !== "AbortError") show({ error: failure(error) });
  }
}

// What a message of the check needs is said beside its control, too.
const NEEDS = [
  ["tip-error", text => /--tip|tip link/.test(text) || text.includes(`unknown link '${$("tip").value.trim()}'`), "Choose the link that carries the measured point. The check below says why."],
  ["needed-file", text => text.includes("--servos"), "Add the servo file: the measurements have counts of servos."],
  ["needed-file", text => text.includes("--rig"), "Add the rig file: the measurements are image coordinates. If you have none, make one above."],
];

function showNeeds(texts) {
  const needs = NEEDS.filter(([, isMeant]) => texts.some(isMeant));
  for (const id of ["tip-error", "needed-file"]) showError(id, needs.find(need => need[0] === id)?.[2] ?? "");
}

const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

// What was found in the photographs.
function boardCard({ board, images, used, problems }) {
  const missed = Object.entries(problems).map(([name, problem]) => `${name}: ${problem}`);
  return element("div", { className: `card ${used ? missed.length || used < MIN_PHOTOGRAPHS ? "warning" : "ok" : "problem"}` }, element("h3", {}, "Photographs"),
    element("p", {}, `Board ${board} was found in ${used} of ${count(images, "photograph")}.`),
    used < MIN_PHOTOGRAPHS ? element("p", {}, `Take at least ${MIN_PHOTOGRAPHS}, better twice as many, that differ in all joints.`) : null, list(missed));
}

function fileCard(file) {
  const bad = Object.entries(file.bad_rows).map(([line, reason]) => `line ${line}: ${reason}`);
  const warnings = [...file.warnings, ...bad.slice(0, 5), ...(bad.length > 5 ? [`${bad.length - 5} more rows cannot be used`] : [])];
  const state = file.problem ? "problem" : warnings.length ? "warning" : "ok";
  const facts = [file.kind, count(file.rows, "row"), file.configurations ? count(file.configurations, "configuration") : "", file.form];
  const out = element("div", { className: `card ${state}` },
    element("h3", {}, file.path), element("p", {}, facts.filter(Boolean).join(", ")),
    file.problem ? element("p", {}, spoken(file.problem)) : null, list(warnings.map(spoken)), list(file.notes.map(spoken)),
    state === "ok" && !file.notes.length ? element("p", {}, "No problems found.") : null);
  if (file.column_map.length) out.append(...proposedMap(file.column_map));
  const rows = file.columns.map(column => [column.name, column.unit, column.role, short(column.minimum), short(column.maximum),
    column.lower === null ? "" : `${short(column.lower)} to ${short(column.upper)}`,
    column.coverage === null ? "" : `${Math.round(100 * column.coverage)} %`]);
  out.append(element("details", {}, element("summary", {}, count(file.columns.length, "column")),
    table(`Columns of ${file.path}`, ["column", "unit", "use", "smallest", "largest", "limits", "visited 5° bins"], rows)));
  for (const { name, counts } of file.columns.filter(({ role, counts }) => role === "other" && Object.keys(counts).length)) {
    out.append(element("details", {}, element("summary", {}, `Rows of each ${name} (${Object.keys(counts).length})`),
      table(`Rows of each ${name} in ${file.path}`, [name, "rows"], Object.entries(counts))));
  }
  return out;
}

const short = value => value === null || value === undefined ? "" : String(Number(value.toPrecision(6)));

// A column map that the check proposes can be edited and used.
function proposedMap(lines) {
  const text = element("textarea", { rows: 5, value: `${lines.join("\n")}\n`, spellcheck: false, id: "map-text" });
  const use = element("button", { type: "button" }, "Use this column map");
  use.onclick = () => addFiles([new File([text.value], "columns.toml", { type: "text/plain" })], null, true);
  return [element("label", { htmlFor: "map-text" }, "Proposed column map. Check the units and the order of the joints."), text, use];
}

// --- calibration -----------------------------------------------------------------------------------

function showMends() {
  $("mends").hidden = !mends.length;
  const drop = element("button", { type: "button" }, "Undo");
  drop.onclick = () => { mends.length = 0; showMends(); $("calibrate").focus(); };
  $("mends").replaceChildren(element("div", { className: "card buttons" }, `The measurements are changed before the fit: ${mends.join(", ")}`, drop));
}

function setRunning(controller) {
  running = controller;
  updateButtons();
  $("phase").textContent = "reading the files";
}

async function calibrate(force = false) {
  const holdout = $("holdout"), isFile = holdout.selectedOptions[0].dataset.file !== undefined;
  const request = {
    data: named("data").filter(name => !isFile || name !== holdout.value),
    parameters: $("parameters").value, holdout: holdout.value, "skip-bad-rows": $("skip-bad-rows").checked, mend: mends, force,
  };
  clearResult();
  await watch("calibrate", form(request));
}

// Shows a calibration that the request starts, or follows without a form, until its end.
async function watch(operation, body = null) {
  $("status").textContent = "The calibration is running.";
  setRunning(new AbortController());
  $("cancel").focus();
  try {
    await send(operation, body, running.signal, message => {
      if (message.phase) showProgress(message);
      else if (message.error) throw new Error(spoken(message.error));
      else showResult(message);
    });
    $("status").textContent = "";
  } catch (error) {
    const cancelled = error.name === "AbortError";
    $("status").textContent = cancelled ? "Cancelled. Nothing was kept." : "";
    if (!cancelled) showError("run-error", failure(error));
  }
  const focused = document.activeElement === $("cancel");
  setRunning(null);
  if (!$("result").hidden) $("result").focus();
  else if (focused) $("calibrate").focus();
}

function cancel() {
  if (sessionStorage.job) fetch(`job/${sessionStorage.job}`, { method: "DELETE" }).catch(() => {});
  sessionStorage.removeItem("job");
  running?.abort();
}

function clearResult() {
  for (const link of links.splice(0)) URL.revokeObjectURL(link);
  $("result").hidden = true;
  if (!running) {
    sessionStorage.removeItem("job");
    $("status").textContent = "";
  }
  showError("run-error", "");
}

function showProgress({ phase, step, total }) {
  $("phase").textContent = total > 1 ? `${phase}, step ${step}` : phase;
}

// Rows of the accuracy table, the most important one first.
function accuracies(result) {
  const sets = [
    ["hold-out", "holdout_"], ["cross-validated", "cross_validated_"], ["left-out regions of joint space", "holdout_region_"], ["fitted", ""],
  ];
  const out = [];
  for (const [title, prefix] of sets) {
    const { n_samples, n_outliers } = result.comparisons.find(each => each.title === title) ?? {};
    const judged = n_samples === undefined ? title : `${count(n_samples, `${title} row`)}${n_outliers ? `, without ${count(n_outliers, "outlier")}` : ""}`;
    const before = result[`${prefix}before`], after = result[`${prefix}after`];
    if (!before || !after || (prefix === "holdout_" && !result.samples_holdout)) continue;
    const add = (quantity, key, format) => {
      if (before[key] !== undefined && before[key] !== null) out.push([quantity, judged, format(before[key]), format(after[key])]);
    };
    add("RMS position error", "position_rms_m", value => `${digits(1e3 * value)} mm`);
    add("RMS orientation error", "orientation_rms_rad", value => `${digits(1e3 * value)} mrad`);
    add("RMS error at the board", "board_rms_m", value => `${digits(1e3 * value)} mm`);
    add(before.unit === "px" ? "RMS image error" : "RMS residual error", "residual_rms", value => before.unit === "m" ? `${digits(1e3 * value)} mm` : `${digits(value)} ${before.unit ?? ""}`);
  }
  return out;
}

const digits = value => value === 0 ? "0" : String(Number(value.toPrecision(value < 10 ? 2 : 3)));

const VERDICTS = {
  ok: "Verdict: ok", caution: "Verdict: caution", refused: "Verdict: refused. No robot is written.",
  forced: "Verdict: refused. The robot is written all the same.",
};

function showResult({ result, status, screen, files: outputs }) {
  const { verdict } = result, rows = accuracies(result), parts = [];
  const isRefused = status === "refused";
  const key = verdict.status === "refused" && !isRefused ? "forced" : verdict.status;
  const buttons = [...mendButtons(verdict.reasons), ...(isRefused ? [forceButton()] : [])];
  parts.push(element("div", { className: `card ${verdict.status}` }, element("p", { className: "verdict" }, VERDICTS[key]),
    list(verdict.reasons.map(spoken)), buttons.length ? element("div", { className: "buttons" }, ...buttons) : null));
  if (!isRefused && rows.length) {
    const [quantity, judged, before, after] = rows[0];
    const value = (name, text) => element("div", {}, element("dt", {}, name), element("dd", {}, text));
    parts.push(element("h3", {}, `${quantity}, ${judged}`),
      element("dl", { className: "headline" }, value("before", before), value("after", after)));
  }
  const tables = [...new Set(rows.map(([name]) => name))].map(quantity =>
    table(quantity, ["judged on", "before", "after"], rows.filter(([name]) => name === quantity).map(([, ...row]) => row)));
  // Nothing may rely on the errors of a robot that is not written.
  if (isRefused && rows.length) parts.push(element("details", {}, element("summary", {}, "Errors of the refused fit"), ...tables));
  else if (rows.length) parts.push(...tables, ...jointSpace(result));
  if (result.warnings.length) parts.push(element("div", { className: "card warning" }, element("h3", {}, "Warnings"), list(result.warnings.map(spoken))));
  parts.push(element("h3", {}, "Files"), element("ul", { id: "downloads" }, ...outputs.map(downloadItem), ...madeItems()));
  parts.push(element("details", {}, element("summary", {}, "The same on the command line"),
    element("pre", { tabIndex: 0 }, `${result.command} -o ${outputName(outputs)}`), element("pre", { tabIndex: 0 }, screen)));
  $("result").replaceChildren(...parts);
  $("result").hidden = false;
}

// Where the accuracy holds.
function jointSpace({ covered_share: covered, reached_share: reached }) {
  if (covered === null || reached === null) return [];
  return [element("p", {}, `The measured region is ${percent(covered)} of joint space. Accuracy unknown: ${percent(1 - reached)} of joint space, far from all measured poses.`)];
}

// A share of random configurations is never exactly 0 or 100 %.
const percent = share => share < 0.01 ? "under 1 %" : share > 0.99 ? "over 99 %" : `${Math.round(100 * share)} %`;

const outputName = outputs => outputs.find(({ name }) => /_calibrated\.(json|urdf)$/.test(name))?.name ?? "calibrated.urdf";

// Buttons for the remedies that the reasons name.
function mendButtons(reasons) {
  const keys = [...reasons.join(" ").matchAll(/--mend (\S+?)[.,;)]?(?=\s|$)/g)].map(match => match[1]).filter(key => !mends.includes(key));
  // Several keys are alternatives.
  return keys.map(key => {
    const text = keys.length > 1 ? `Apply ${key} and calibrate again` : "Apply the change and calibrate again";
    const apply = element("button", { type: "button", className: "primary" }, text);
    apply.onclick = () => { mends.push(key); showMends(); calibrate(); };
    return apply;
  });
}

function forceButton() {
  const force = element("button", { type: "button" }, "Write the robot all the same");
  force.onclick = () => calibrate(true);
  return force;
}

function downloadItem({ name, label, use, content }) {
  const bytes = Uint8Array.from(atob(content), char => char.charCodeAt(0));
  const type = name.endsWith(".html") ? "text/html" : "application/octet-stream";
  return fileItem(name, label, use, new Blob([bytes], { type }));
}

// Input files that only this page has.
function madeItems() {
  return [...files].filter(([, entry]) => entry.isMade).map(([name, { file }]) => fileItem(name, "Input", "made in this page; the command line below needs it", file));
}

function fileItem(name, label, use, blob) {
  const href = URL.createObjectURL(blob);
  links.push(href);
  const out = element("li", {}, element("span", { className: "label" }, label, element("small", {}, use)),
    element("a", { href, download: name, ariaLabel: `Download ${name}` }, name));
  if (blob.type === "text/html") out.append(element("a", { href, target: "_blank", ariaLabel: `Open ${name} in a new tab` }, "Open"));
  return out;
}

// --- events ----------------------------------------------------------------------------------------

$("picker").onchange = event => { addFiles(event.target.files); event.target.value = ""; };
for (const name of ["dragover", "dragleave", "drop"]) {
  addEventListener(name, event => {
    event.preventDefault();
    $("drop").classList.toggle("over", name === "dragover");
    if (name === "drop") addFiles(event.dataTransfer.files);
  });
}
$("tip").onchange = $("sheet").onchange = check;
for (const field of document.querySelectorAll("#rig-fields :is(select, input)")) field.oninput = writeRig;
for (const button of document.querySelectorAll("[data-paper]")) button.onclick = () => printBoard(button.dataset.paper);
$("rig-text").oninput = rigEdited;
$("rig-save").onclick = async () => {
  const content = btoa(String.fromCodePoint(...new Uint8Array(await rigFile().arrayBuffer())));
  downloadItem({ name: "rig.toml", label: "", use: "", content }).querySelector("a").click();
};
$("rig-use").onclick = async () => {
  showError("rig-error", "");
  await addFiles([rigFile()], "rig", true);
  $("rig-status").textContent = "rig.toml is among the files.";
};
writeRig();
$("example").onclick = async () => {
  if (files.size && !confirm("The example takes the place of all files of this page. Continue?")) return;
  try {
    const example = await (await fetch("example")).json();
    files.clear();
    $("tip").value = example.tip;
    await addFiles(Object.entries(example.files).map(([name, text]) => new File([text], name)), null, true);
  } catch (error) {
    showError("file-error", failure(error));
  }
};
$("options").onsubmit = event => event.preventDefault();
$("calibrate").onclick = () => calibrate();
$("cancel").onclick = cancel;
if (sessionStorage.files) showError("file-error", `The page was loaded again, which removes its files. To calibrate, add them again: ${sessionStorage.files}`);
if (sessionStorage.job) watch(`job/${sessionStorage.job}`);
