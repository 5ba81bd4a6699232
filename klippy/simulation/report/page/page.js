"use strict";
// The page's behaviour: charts over time that zoom together, and the view of one layer.
// The data element holds base64 arrays: per series the lowest and greatest value of each bucket of rows.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function decode(text, Type) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Type(bytes.buffer);
  }

  function element(tag, properties, parent) {
    const made = Object.assign(document.createElement(tag), properties);
    if (parent) parent.append(made);
    return made;
  }

  // A canvas of the width it is given on the page, sharp on any screen; returns its context and size in CSS pixels.
  function fitted(canvas, height) {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth;
    canvas.style.height = height + "px";
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.font = "12px system-ui, sans-serif";
    return { g, width, height };
  }

  // --- scales -----------------------------------------------------------------------------------
  const TIME_STEPS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200];

  function timeStep(span, count) {
    return TIME_STEPS.find((s) => span / s <= count) || 14400;
  }

  function valueStep(span, count) {
    const raw = span / count;
    const power = Math.pow(10, Math.floor(Math.log10(raw)));
    return power * [1, 2, 5, 10].find((m) => m * power >= raw);
  }

  function timeText(t, step) {
    if (step < 60 && view.to < 180) return t.toFixed(step < 0.1 ? 2 : step < 1 ? 1 : 0) + " s";
    const whole = Math.round(t * 100) / 100;
    const h = Math.floor(whole / 3600), m = Math.floor(whole / 60) % 60, s = whole - 3600 * h - 60 * m;
    const seconds = step < 1 ? s.toFixed(2).padStart(5, "0") : String(Math.round(s)).padStart(2, "0");
    return (h ? h + ":" + String(m).padStart(2, "0") : m) + ":" + seconds;
  }

  function valueText(v, step) {
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return v.toFixed(digits).replace("-", "−");
  }

  // Index of the last bucket that begins at or before t.
  function bucketAt(t) {
    let low = 0, high = time.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (time[middle] <= t) low = middle; else high = middle - 1;
    }
    return low;
  }

  // --- charts over time ---------------------------------------------------------------------------
  const time = decode(data.time, Float32Array);
  const whole = data.views[0];
  const view = { from: whole.from, to: whole.to };
  const LEFT = 52, RIGHT = 10, TOP = 8, BOTTOM = 20;
  const charts = data.charts.map(makeChart);
  let drawn = 0;

  function makeChart(spec) {
    const box = element("div", { className: "chart" }, byId("charts"));
    const legend = element("div", { className: "legend" }, box);
    element("strong", { textContent: spec.title + ", " + spec.unit }, legend);
    const series = spec.series.map((s) => makeSeries(s, legend));
    const when = element("span", { className: "time" }, legend);
    const canvas = element("canvas", { height: spec.height }, box);
    return { spec, series, canvas, when, range: [0, 1] };
  }

  function makeSeries(spec, legend) {
    const low = decode(spec.low, Float32Array);
    const high = spec.high === null ? low : decode(spec.high, Float32Array);
    const label = element("label", { className: spec.shown ? "on" : "" }, legend);
    const box = element("input", { type: "checkbox", checked: spec.shown }, label);
    element("i", {}, label).style.background = css("--c-" + spec.colour);
    label.append(spec.label);
    const value = element("output", {}, label);
    const series = { spec, low, high, value, shown: spec.shown };
    box.addEventListener("change", () => {
      series.shown = box.checked;
      label.className = box.checked ? "on" : "";
      redraw();
    });
    return series;
  }

  function visibleRange(chart, first, last) {
    let lowest = Infinity, greatest = -Infinity;
    for (const s of chart.series) {
      if (!s.shown) continue;
      for (let i = first; i <= last; i++) {
        if (s.low[i] < lowest) lowest = s.low[i];
        if (s.high[i] > greatest) greatest = s.high[i];
      }
    }
    if (lowest > greatest) return [0, 1];
    const limit = chart.spec.limit;
    if (limit !== null) {
      lowest = Math.max(-limit, Math.min(lowest, -data.band_c));
      greatest = Math.min(limit, Math.max(greatest, data.band_c));
    }
    if (chart.spec.fromZero) lowest = Math.min(lowest, 0);
    const room = Math.max(0.05 * (greatest - lowest), 1e-3);
    return [chart.spec.fromZero && lowest === 0 ? 0 : lowest - room, greatest + room];
  }

  function drawChart(chart, hover) {
    const { g, width, height } = fitted(chart.canvas, chart.spec.height);
    const first = bucketAt(view.from), last = Math.min(bucketAt(view.to) + 1, time.length - 1);
    const [bottom, top] = visibleRange(chart, first, last);
    const plot = { left: LEFT, right: width - RIGHT, top: TOP, bottom: height - BOTTOM };
    const x = (t) => plot.left + ((t - view.from) / (view.to - view.from)) * (plot.right - plot.left);
    const y = (v) => plot.bottom - ((v - bottom) / (top - bottom)) * (plot.bottom - plot.top);
    drawGrid(g, chart, plot, x, y, bottom, top);
    g.save();
    g.beginPath();
    g.rect(plot.left, plot.top, plot.right - plot.left, plot.bottom - plot.top);
    g.clip();
    if (chart.spec.limit !== null) {
      g.fillStyle = css("--band");
      g.fillRect(plot.left, y(data.band_c), plot.right - plot.left, y(-data.band_c) - y(data.band_c));
    }
    for (const s of chart.series) if (s.shown) drawSeries(g, s, first, last, x, y);
    if (hover !== null) {
      g.strokeStyle = css("--soft");
      g.lineWidth = 1;
      g.strokeRect(Math.round(x(hover)) + 0.5, plot.top - 1, 0, plot.bottom - plot.top + 2);
    }
    g.restore();
  }

  function drawGrid(g, chart, plot, x, y, bottom, top) {
    g.strokeStyle = css("--grid");
    g.fillStyle = css("--soft");
    g.lineWidth = 1;
    g.beginPath();
    const dv = valueStep(top - bottom, Math.max(3, (plot.bottom - plot.top) / 36));
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let v = Math.ceil(bottom / dv) * dv; v <= top; v += dv) {
      const at = Math.round(y(v)) + 0.5;
      g.moveTo(plot.left, at);
      g.lineTo(plot.right, at);
      g.fillText(valueText(Math.abs(v) < dv / 2 ? 0 : v, dv), plot.left - 7, at);
    }
    const dt = timeStep(view.to - view.from, (plot.right - plot.left) / 90);
    g.textAlign = "center";
    g.textBaseline = "top";
    for (let t = Math.ceil(view.from / dt) * dt; t <= view.to; t += dt) {
      const at = Math.round(x(t)) + 0.5;
      g.moveTo(at, plot.top);
      g.lineTo(at, plot.bottom);
      g.fillText(timeText(t, dt), Math.min(at, plot.right - 14), plot.bottom + 5);
    }
    g.stroke();
  }

  // One vertical stroke a pixel column from the lowest to the greatest value in it, joined along the line.
  function drawSeries(g, series, first, last, x, y) {
    g.strokeStyle = css("--c-" + series.spec.colour);
    g.lineWidth = series.spec.dashed ? 1.4 : 1.2;
    g.lineJoin = "round";
    g.setLineDash(series.spec.dashed ? [5, 4] : []);
    g.beginPath();
    let i = first;
    while (i <= last) {
      const column = Math.floor(x(time[i]));
      let lowest = series.low[i], greatest = series.high[i], j = i + 1;
      while (j <= last && Math.floor(x(time[j])) === column) {
        if (series.low[j] < lowest) lowest = series.low[j];
        if (series.high[j] > greatest) greatest = series.high[j];
        j++;
      }
      const at = j === i + 1 ? x(time[i]) : column + 0.5;
      g.lineTo(at, y(greatest));
      if (lowest !== greatest) g.lineTo(at, y(lowest));
      i = j;
    }
    g.stroke();
    g.setLineDash([]);
  }

  function showValues(hover) {
    for (const chart of charts) {
      chart.when.textContent = hover === null ? "" : timeText(hover, 0.01);
      for (const s of chart.series) {
        const i = hover === null ? 0 : bucketAt(hover);
        const digits = Math.abs(s.high[i]) >= 1000 ? 0 : 2;
        s.value.textContent = hover === null ? "" : valueText((s.low[i] + s.high[i]) / 2, Math.pow(10, -digits));
      }
    }
  }

  function redraw(hover = null) {
    const ticket = ++drawn;
    requestAnimationFrame(() => {
      if (ticket !== drawn) return;
      for (const chart of charts) drawChart(chart, hover);
      showValues(hover);
    });
  }

  function setView(from, to) {
    const span = Math.max(Math.min(to - from, whole.to - whole.from), 0.2);
    view.from = Math.min(Math.max(from, whole.from), whole.to - span);
    view.to = view.from + span;
    redraw();
  }

  function bindChart(chart) {
    const canvas = chart.canvas;
    const timeAt = (event) => {
      const part = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - RIGHT);
      return view.from + Math.min(Math.max(part, 0), 1) * (view.to - view.from);
    };
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      held = { time: timeAt(event), x: event.offsetX, from: view.from, to: view.to, moves: event.shiftKey };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (held === null) { redraw(timeAt(event)); return; }
      if (held.moves) {
        const shift = ((event.offsetX - held.x) / (canvas.clientWidth - LEFT - RIGHT)) * (held.to - held.from);
        setView(held.from - shift, held.to - shift);
      } else {
        redraw(timeAt(event));
        requestAnimationFrame(() => shadeSelection(chart, held, event.offsetX));
      }
    });
    canvas.addEventListener("pointerup", (event) => {
      if (held !== null && !held.moves && Math.abs(event.offsetX - held.x) > 5) {
        const t = timeAt(event);
        setView(Math.min(t, held.time), Math.max(t, held.time));
      }
      held = null;
    });
    canvas.addEventListener("pointerleave", () => { if (held === null) redraw(); });
    canvas.addEventListener("dblclick", () => setView(whole.from, whole.to));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      const t = timeAt(event), factor = Math.pow(1.002, event.deltaY);
      setView(t - (t - view.from) * factor, t + (view.to - t) * factor);
    }, { passive: false });
  }

  function shadeSelection(chart, held, x) {
    if (held === null) return;
    const g = chart.canvas.getContext("2d");
    g.globalAlpha = 0.15;
    g.fillStyle = css("--accent");
    g.fillRect(held.x, TOP, x - held.x, chart.spec.height - TOP - BOTTOM);
    g.globalAlpha = 1;
  }

  charts.forEach(bindChart);
  for (const v of data.views) {
    element("button", { textContent: v.label, onclick: () => setView(v.from, v.to) }, byId("views"));
  }

  // --- layers -------------------------------------------------------------------------------------
  const layers = data.layers;
  const path = data.path;
  if (path.points) {
    path.px = decode(path.x, Uint16Array);
    path.py = decode(path.y, Uint16Array);
    path.perr = decode(path.error, Int8Array);
    path.ppen = decode(path.pen, Uint8Array);
    path.ptemp = decode(path.temp, Uint8Array);
    path.pflow = decode(path.flow, Uint8Array);
  }
  const colourSpan = layers.length ? niceSpan() : 1;
  const EVEN = [["--cold", 0], ["--even", 0.5], ["--hot", 1]];
  const RISING = [["--low", 0], ["--middle", 0.5], ["--high", 1]];
  const stored = (scaled, i) => (path[scaled][i] / 255) * 254; // index into a palette of 255
  // what the path may be coloured by: palette, where a point is in it, and the texts at its ends
  const COLOURS = {
    error: {
      palette: makePalette(EVEN), at: (i) => errorIndex(path.perr[i]),
      from: "true minus target: −" + colourSpan + " °C", to: "+" + colourSpan + " °C",
    },
    temp: {
      palette: makePalette(RISING), at: (i) => stored("ptemp", i),
      from: "true temperature: " + path.tempLow + " °C", to: path.tempHigh + " °C",
    },
    flow: {
      palette: makePalette(RISING), at: (i) => stored("pflow", i),
      from: "flow: 0", to: path.flowHigh + " mm³/s",
    },
  };
  let current = Math.floor(layers.length / 2);
  let colour = COLOURS.error;

  // Errors at which the colours end: typical layers should show colour, an odd one may saturate.
  function niceSpan() {
    const sizes = layers.map((l) => Math.max(-l.min, l.max)).sort((a, b) => a - b);
    const typical = sizes[Math.floor(0.9 * (sizes.length - 1))];
    return Math.min([0.5, 1, 2, 3, 5].find((s) => s >= typical) || 5, path.errorSpan || 5);
  }

  function makePalette(stops) {
    const strip = element("canvas", { width: 255, height: 1 });
    const g = strip.getContext("2d");
    const ramp = g.createLinearGradient(0, 0, 255, 0);
    stops.forEach(([name, at]) => ramp.addColorStop(at, css(name)));
    g.fillStyle = ramp;
    g.fillRect(0, 0, 255, 1);
    const pixels = g.getImageData(0, 0, 255, 1).data;
    return Array.from({ length: 255 }, (_, i) => `rgb(${pixels[4 * i]},${pixels[4 * i + 1]},${pixels[4 * i + 2]})`);
  }

  function errorIndex(storedError) {
    const error = (storedError / 127) * path.errorSpan;
    return 127 + 127 * Math.max(-1, Math.min(1, error / colourSpan));
  }

  function drawBars() {
    const { g, width, height } = fitted(byId("layer-bars"), 190);
    const plot = { left: LEFT, right: width - RIGHT, top: TOP, bottom: height - BOTTOM };
    const lowest = Math.min(-data.band_c, ...layers.map((l) => Math.max(l.min, -2 * data.band_c)));
    const greatest = Math.max(data.band_c, ...layers.map((l) => Math.min(l.max, 2 * data.band_c)));
    const y = (v) => plot.bottom - ((v - lowest) / (greatest - lowest)) * (plot.bottom - plot.top);
    const step = (plot.right - plot.left) / layers.length;
    g.fillStyle = css("--band");
    g.fillRect(plot.left, y(data.band_c), plot.right - plot.left, y(-data.band_c) - y(data.band_c));
    drawBarGrid(g, plot, y, lowest, greatest, step);
    g.beginPath();
    g.rect(plot.left, plot.top, plot.right - plot.left, plot.bottom - plot.top);
    g.clip(); // an odd layer may go beyond the scale
    layers.forEach((layer, i) => {
      const x = plot.left + (i + 0.5) * step, w = Math.max(Math.min(step * 0.6, 9), 1);
      const tall = Math.max(y(layer.min) - y(layer.max), 1);
      g.fillStyle = i === current ? css("--accent") : css("--c-estimate");
      g.globalAlpha = i === current ? 0.55 : 0.3;
      g.fillRect(x - w / 2, y(layer.max), w, tall);
      g.globalAlpha = 1;
      g.fillRect(x - Math.max(w, 3) / 2, y(layer.mean) - 1, Math.max(w, 3), 2.5);
    });
  }

  function drawBarGrid(g, plot, y, lowest, greatest, step) {
    g.strokeStyle = css("--grid");
    g.beginPath();
    const dv = valueStep(greatest - lowest, 5);
    for (let v = Math.ceil(lowest / dv) * dv; v <= greatest; v += dv) {
      const at = Math.round(y(v)) + 0.5;
      g.moveTo(plot.left, at);
      g.lineTo(plot.right, at);
    }
    g.stroke();
    g.fillStyle = css("--soft");
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let v = Math.ceil(lowest / dv) * dv; v <= greatest; v += dv) g.fillText(valueText(v, dv), plot.left - 7, y(v));
    g.textAlign = "center";
    g.textBaseline = "top";
    const every = Math.max(1, valueStep(layers.length, (plot.right - plot.left) / 70));
    for (let n = every; n <= layers.length; n += every) {
      g.fillText(String(n), plot.left + (n - 0.5) * step, plot.bottom + 5);
    }
  }

  function drawLayer() {
    const canvas = byId("layer-canvas");
    const { g, width, height } = fitted(canvas, Math.min(460, Math.max(canvas.clientWidth, 200)));
    if (!path.points) return;
    const first = path.starts[current];
    const end = current + 1 < path.starts.length ? path.starts[current + 1] : path.points;
    const box = bounds(first, end);
    const scale = Math.min((width - 30) / Math.max(box.w, 1), (height - 30) / Math.max(box.h, 1));
    const x = (i) => width / 2 + (path.px[i] - box.x - box.w / 2) * scale;
    const y = (i) => height / 2 - (path.py[i] - box.y - box.h / 2) * scale;
    g.lineWidth = Math.max(1.2, Math.min(0.4 * (65535 / path.side) * scale, 7));
    g.lineCap = "round";
    for (let i = first + 1; i < end; i++) {
      if (!path.ppen[i]) continue;
      g.strokeStyle = colour.palette[Math.round(colour.at(i))];
      g.beginPath();
      g.moveTo(x(i - 1), y(i - 1));
      g.lineTo(x(i), y(i));
      g.stroke();
    }
  }

  function bounds(first, end) {
    let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity;
    for (let i = first; i < end; i++) {
      x0 = Math.min(x0, path.px[i]); x1 = Math.max(x1, path.px[i]);
      y0 = Math.min(y0, path.py[i]); y1 = Math.max(y1, path.py[i]);
    }
    return { x: x0, y: y0, w: x1 - x0, h: y1 - y0 };
  }

  function describeLayer() {
    const layer = layers[current];
    const signed = (v) => (v > 0 ? "+" : "") + valueText(v, 0.01) + " °C";
    const facts = [
      ["layer", `${current + 1} of ${layers.length}, z = ${layer.z.toFixed(2)} mm`],
      ["starts at", timeText(layer.start, 1)],
      ["takes", layer.duration.toFixed(1) + " s"],
      ["true temperature, mean", layer.true.toFixed(1) + " °C"],
      ["error, mean", signed(layer.mean)],
      ["error, min to max", signed(layer.min) + " to " + signed(layer.max)],
      ["flow, mean", layer.flow.toFixed(2) + " mm³/s"],
      ["flow, greatest", layer.flowMax.toFixed(2) + " mm³/s"],
    ];
    const list = byId("layer-facts");
    list.replaceChildren();
    for (const [name, text] of facts) {
      element("dt", { textContent: name }, list);
      element("dd", { textContent: text }, list);
    }
    const place = element("button", { textContent: "show over time" }, list);
    place.addEventListener("click", () => {
      setView(layer.start, layer.start + layer.duration);
      byId("charts").scrollIntoView({ behavior: "smooth" });
    });
  }

  function showLayer(index) {
    current = Math.max(0, Math.min(layers.length - 1, index));
    byId("layer-slider").value = current;
    drawBars();
    drawLayer();
    describeLayer();
  }

  function showColour(name) {
    colour = COLOURS[name] || COLOURS.error;
    byId("layer-colour").value = COLOURS[name] ? name : "error";
    const scale = byId("layer-scale");
    scale.replaceChildren();
    element("span", { textContent: colour.from }, scale);
    const middle = colour.palette[127];
    element("i", {}, scale).style.background =
      `linear-gradient(to right, ${colour.palette[0]}, ${middle}, ${colour.palette[254]})`;
    element("span", { textContent: colour.to }, scale);
  }

  // The layer and the colours of a link: report.html#layer=12&colour=temp
  function readHash() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    showColour(wanted.get("colour") || "error");
    const number = Number(wanted.get("layer"));
    showLayer(number >= 1 ? Math.round(number) - 1 : current);
    if (number >= 1) byId("layers").scrollIntoView();
  }

  function writeHash() {
    const text = "#layer=" + (current + 1) + "&colour=" + byId("layer-colour").value;
    history.replaceState(null, "", text);
  }

  function bindLayers() {
    byId("layer-slider").addEventListener("input", (event) => {
      showLayer(Number(event.target.value));
      writeHash();
    });
    byId("layer-colour").addEventListener("change", (event) => {
      showColour(event.target.value);
      drawLayer();
      writeHash();
    });
    window.addEventListener("hashchange", readHash);
    byId("layer-bars").addEventListener("click", (event) => {
      const part = (event.offsetX - LEFT) / (event.target.clientWidth - LEFT - RIGHT);
      showLayer(Math.floor(part * layers.length));
      writeHash();
    });
    readHash();
  }

  if (layers.length) bindLayers();
  window.addEventListener("resize", () => { redraw(); if (layers.length) { drawBars(); drawLayer(); } });
  redraw();
})();
