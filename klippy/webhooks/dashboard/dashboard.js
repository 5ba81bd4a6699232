// A plain dashboard by Moonraker's JSON-RPC: temperatures, print, console, dialogs, emergency stop.
"use strict";

const HEATERS = { extruder: "Nozzle", heater_bed: "Bed" };
const COLOURS = { extruder: "#c62828", heater_bed: "#1565c0" };
const RETRY_MS = 1000, HISTORY_S = 300, SCALE_C = 300;
const WANTED = { print_stats: null, virtual_sdcard: null, display_status: null, extruder: null, heater_bed: null };
const at = (id) => document.getElementById(id);

let socket = null, nextId = 1;
const waiting = new Map(), status = {}, history = {};

function call(method, params = {}) {
  return new Promise((resolve, reject) => {
    const id = nextId++;
    waiting.set(id, { resolve, reject });
    socket.send(JSON.stringify({ jsonrpc: "2.0", method, params, id }));
  });
}

function say(text, isError = false) {
  const line = document.createElement("div");
  line.textContent = text;
  line.className = isError ? "error" : "";
  at("log").append(line);
  at("log").scrollTop = at("log").scrollHeight; // not the page: the emergency stop stays in view
}

const run = (method, params) => call(method, params).catch((error) => say(error.message, true));
const gcode = (script) => run("printer.gcode.script", { script });

// Dialogs that the printer asks for: lines "// action:prompt_..."
function prompt(action, text) {
  if (action === "begin") {
    at("prompt-title").textContent = text;
    at("prompt-text").textContent = "";
    at("prompt-buttons").replaceChildren();
  } else if (action === "text") {
    at("prompt-text").append(text, document.createElement("br"));
  } else if (action.endsWith("button")) {
    const [label, script] = text.split("|");
    const button = document.createElement("button");
    button.textContent = label;
    button.onclick = () => gcode(script || label);
    at("prompt-buttons").append(button);
  } else if (action === "show") at("prompt").hidden = false;
  else if (action === "end") at("prompt").hidden = true;
}

function received(line) {
  const action = line.match(/^\/\/ action:prompt_(\w+)\s*(.*)$/);
  if (action) prompt(action[1], action[2]);
  else say(line, line.startsWith("!!"));
}

function merge(changes) {
  for (const [name, fields] of Object.entries(changes)) status[name] = { ...status[name], ...fields };
  show();
}

function heaterRow(name) {
  const row = document.createElement("tr");
  row.id = `row-${name}`;
  row.innerHTML = `<td>${HEATERS[name]}<td class="temp"><td class="target"><td class="power">
    <td><form><input type="number" min="0" aria-label="Target of the ${HEATERS[name]}"> <button>Set</button></form>`;
  row.querySelector("form").onsubmit = (event) => {
    event.preventDefault();
    gcode(`SET_HEATER_TEMPERATURE HEATER=${name} TARGET=${Number(row.querySelector("input").value) || 0}`);
  };
  at("heaters").append(row);
  return row;
}

function show() {
  for (const name of Object.keys(HEATERS)) {
    const heater = status[name];
    if (!heater || heater.temperature === undefined) continue;
    const row = at(`row-${name}`) || heaterRow(name);
    const source = heater.temperature_source || "measured"; // an induction nozzle says where it comes from
    row.cells[0].textContent = HEATERS[name] + (source === "measured" ? "" : `, ${source}`);
    row.querySelector(".temp").textContent = heater.temperature.toFixed(1);
    row.querySelector(".target").textContent = heater.target.toFixed(0);
    row.querySelector(".power").textContent = (100 * (heater.power || 0)).toFixed(0);
  }
  const print = status.print_stats || {}, card = status.virtual_sdcard || {};
  at("print").textContent = print.state || "standby";
  at("file").textContent = print.filename || "";
  at("progress").textContent = print.filename ? `${(100 * (card.progress || 0)).toFixed(0)} %` : "";
  at("message").textContent = print.message || (status.display_status || {}).message || "";
  at("pause").disabled = at("cancel").disabled = print.state !== "printing";
  at("resume").disabled = print.state !== "paused";
  if (print.state === "paused") at("cancel").disabled = false;
}

function draw() {
  const now = Date.now() / 1000, lines = [];
  for (const name of Object.keys(HEATERS)) {
    if (!status[name] || status[name].temperature === undefined) continue;
    const points = (history[name] = (history[name] || []).filter(([t]) => t > now - HISTORY_S));
    points.push([now, status[name].temperature]);
    const path = points.map(([t, c]) => `${600 * (1 - (now - t) / HISTORY_S)},${160 * (1 - c / SCALE_C)}`).join(" ");
    lines.push(`<polyline fill="none" stroke="${COLOURS[name]}" stroke-width="2" points="${path}"/>`);
  }
  const scale = [100, 200, 300].map((c) => {
    const y = 160 * (1 - c / SCALE_C);
    return `<line x1="0" x2="600" y1="${y}" y2="${y}" stroke="#ddd"/><text x="2" y="${y + 11}" font-size="10">${c} °C</text>`;
  });
  at("chart").innerHTML = scale.join("") + lines.join("");
}

async function listFiles() {
  const files = await call("server.files.list", { root: "gcodes" });
  files.sort((a, b) => b.modified - a.modified);
  at("files").replaceChildren(...files.slice(0, 10).map((file) => {
    const row = document.createElement("tr");
    const name = row.insertCell(), button = document.createElement("button");
    name.textContent = file.path;
    button.textContent = "Print";
    button.onclick = () => run("printer.print.start", { filename: file.path });
    row.insertCell().append(button);
    return row;
  }));
}

async function begin() {
  const info = await call("server.info");
  at("state").textContent = info.klippy_state;
  at("restart").hidden = !["shutdown", "error"].includes(info.klippy_state);
  if (info.klippy_state !== "ready") {
    const why = await call("printer.info").catch(() => ({ state_message: "The host is not connected" }));
    at("message").textContent = why.state_message;
    setTimeout(() => begin().catch(() => {}), RETRY_MS);
    return;
  }
  merge((await call("printer.objects.subscribe", { objects: WANTED })).status);
  await listFiles();
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/websocket`);
  socket.onopen = () => begin().catch((error) => say(error.message, true));
  socket.onclose = () => { at("state").textContent = "connecting"; setTimeout(connect, RETRY_MS); };
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.id !== undefined && waiting.has(message.id)) {
      const { resolve, reject } = waiting.get(message.id);
      waiting.delete(message.id);
      if (message.error) reject(message.error);
      else resolve(message.result);
    } else if (message.method === "notify_status_update") merge(message.params[0]);
    else if (message.method === "notify_gcode_response") received(message.params[0]);
    else if (message.method === "notify_filelist_changed") listFiles();
    else if (String(message.method).startsWith("notify_klippy_")) begin().catch(() => {});
  };
}

at("stop").onclick = () => run("printer.emergency_stop");
at("restart").onclick = () => run("printer.firmware_restart");
for (const name of ["pause", "resume", "cancel"]) at(name).onclick = () => run(`printer.print.${name}`);
at("console").onsubmit = (event) => {
  event.preventDefault();
  say(`> ${at("console-line").value}`);
  gcode(at("console-line").value);
  at("console-line").value = "";
};
at("upload").onchange = async () => {
  const form = new FormData();
  form.append("file", at("upload").files[0]);
  const answer = await fetch("/server/files/upload", { method: "POST", body: form });
  if (!answer.ok) say(`The upload failed: ${answer.statusText}`, true);
};
setInterval(draw, RETRY_MS);
connect();
