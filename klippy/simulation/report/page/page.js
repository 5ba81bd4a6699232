"use strict";
// The page's behaviour: charts over time that zoom together, and the view of one layer.
// The data element holds base64 arrays; a thinned series alternates the lowest and the greatest value of a bucket.
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

  const number = (v, digits) => v.toFixed(digits).replace("-", "−");

  // --- what all charts share ----------------------------------------------------------------------
  const plots = [];

  function axis(label, more) {
    return {
      label, labelSize: 20, labelFont: "12px system-ui, sans-serif", font: "12px system-ui, sans-serif", size: 56,
      stroke: () => css("--soft"), grid: { stroke: () => css("--grid"), width: 1 },
      ticks: { stroke: () => css("--grid"), width: 1, size: 4 }, ...more,
    };
  }

  function plot(box, height, options, values) {
    const made = new uPlot({ width: box.clientWidth, height, padding: [8, 24, 0, 0], ...options }, values, box);
    plots.push({ made, box, height });
    return made;
  }

  function shadeBand(u) {
    const top = u.valToPos(data.band_c, "y", true), bottom = u.valToPos(-data.band_c, "y", true);
    u.ctx.fillStyle = css("--band");
    u.ctx.fillRect(u.bbox.left, top, u.bbox.width, bottom - top);
  }

  // The scale of a chart of errors: it shows the band, and ends at the limit.
  function errorRange(lowest, greatest, limit) {
    const bottom = Math.min(lowest, -data.band_c) - 0.3, top = Math.max(greatest, data.band_c) + 0.3;
    return [Math.max(-limit, bottom), Math.min(limit, top)];
  }

  const scaleNote = (limit) => (limit === null ? "" : " (scale to ±" + limit + ", ▲ ▼ where it goes beyond)");

  // A triangle at the edge of the scale where a line goes on beyond it.
  function markCut(u, at, sign) {
    const size = 5 * devicePixelRatio, x = u.valToPos(at, "x", true);
    const y = sign > 0 ? u.bbox.top : u.bbox.top + u.bbox.height;
    u.ctx.beginPath();
    u.ctx.moveTo(x, y);
    u.ctx.lineTo(x - size, y + sign * 1.6 * size);
    u.ctx.lineTo(x + size, y + sign * 1.6 * size);
    u.ctx.fill();
  }

  // --- charts over time ---------------------------------------------------------------------------
  const time = Array.from(decode(data.time, Float32Array));
  const whole = data.views[0];
  const long = whole.to > 600;
  const TIME_STEPS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200];

  function timeText(t, digits = 0) {
    if (!long) return number(t, digits);
    const rest = Math.round(t * 100) / 100, h = Math.floor(rest / 3600), m = Math.floor(rest / 60) % 60;
    const s = (rest % 60).toFixed(digits).padStart(digits ? digits + 3 : 2, "0");
    return h + ":" + String(m).padStart(2, "0") + ":" + s;
  }

  function timeAxis() {
    const digits = (step) => (step < 0.1 ? 2 : step < 1 ? 1 : 0);
    return axis(long ? "simulated time, h:mm:ss" : "simulated time, s", {
      size: 30, space: 80, incrs: TIME_STEPS,
      values: (u, marks, i, space, step) => marks.map((t) => timeText(t, digits(step))),
    });
  }

  function range(spec, lowest, greatest) {
    if (lowest === null) return [0, 1];
    if (spec.limit !== null) return errorRange(lowest, greatest, spec.limit);
    const room = Math.max(0.05 * (greatest - lowest), 1e-3);
    return [spec.fromZero && lowest >= 0 ? 0 : lowest - room, greatest + room];
  }

  function markCuts(u, spec) {
    spec.series.forEach((s, i) => {
      if (!u.series[i + 1].show) return;
      u.ctx.fillStyle = css("--c-" + s.colour);
      for (const [from, to, sign] of s.cuts) {
        const first = Math.max(from, u.scales.x.min), last = Math.min(to, u.scales.x.max);
        if (first <= last) markCut(u, (first + last) / 2, sign);
      }
    });
  }

  function timeSeries(s) {
    return {
      label: s.label, show: s.shown, stroke: () => css("--c-" + s.colour), width: 1.3,
      dash: s.dashed ? [5, 4] : undefined, points: { show: false },
      value: (u, v) => (v === null ? "–" : number(v, Math.abs(v) >= 1000 ? 0 : 2)),
    };
  }

  const charts = data.charts.map((spec, index) => {
    return plot(element("div", { className: "chart" }, byId(index ? "charts" : "first-chart")), spec.height, {
      title: spec.title + ", " + spec.unit + scaleNote(spec.limit),
      cursor: { sync: { key: "time" }, drag: { x: true, y: false, dist: 5 } },
      scales: { x: { time: false }, y: { range: (u, lowest, greatest) => range(spec, lowest, greatest) } },
      axes: [timeAxis(), axis(spec.unit)],
      series: [{ label: "at", value: (u, t) => (t === null ? "–" : timeText(t, 2)) }, ...spec.series.map(timeSeries)],
      hooks: {
        drawClear: [(u) => { if (spec.limit !== null) shadeBand(u); }],
        draw: [(u) => markCuts(u, spec)],
      },
    }, [time, ...spec.series.map((s) => Array.from(decode(s.values, Float32Array), (v) => (isNaN(v) ? null : v)))]);
  });

  function setView(from, to) {
    const span = Math.max(Math.min(to - from, whole.to - whole.from), 0.2);
    const min = Math.min(Math.max(from, whole.from), whole.to - span);
    for (const u of charts) u.setScale("x", { min, max: min + span });
  }

  // Moves the view by `shift` of its width and makes it `factor` as wide.
  function moveView(shift, factor) {
    const { min, max } = charts[0].scales.x;
    const middle = (min + max) / 2 + shift * (max - min), half = (factor * (max - min)) / 2;
    setView(middle - half, middle + half);
  }

  const MOVES = [["◀", "earlier", -0.5, 1], ["▶", "later", 0.5, 1], ["+", "closer", 0, 0.5], ["−", "wider", 0, 2]];
  for (const v of data.views) {
    element("button", { textContent: v.label, onclick: () => setView(v.from, v.to) }, byId("views"));
  }
  for (const [textContent, title, shift, factor] of MOVES) {
    element("button", { textContent, title, onclick: () => moveView(shift, factor) }, byId("views"));
  }

  // --- layers -------------------------------------------------------------------------------------
  const layers = data.layers;
  const path = data.path;
  if (path.points) {
    const mm = (text, from) => Float32Array.from(decode(text, Uint16Array), (v) => from + (v / 65535) * path.side);
    path.px = mm(path.x, path.left);
    path.py = mm(path.y, path.front);
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
  let bars = null, view = null;

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

  function makeBars() {
    const series = (label, opacity, width) => ({
      label, width, stroke: () => css("--c-estimate"), alpha: opacity, points: { show: layers.length < 120, size: 5 },
      value: (u, v) => (v === null ? "–" : number(v, 2) + " °C"),
    });
    const limit = 2 * data.band_c;
    bars = plot(byId("layer-bars"), 220, {
      title: "True minus target over the extruding moves of a layer, °C" + scaleNote(limit),
      cursor: { drag: { x: false, y: false } },
      scales: {
        x: { time: false, range: () => [0.5, layers.length + 0.5] },
        y: { range: (u, lowest, greatest) => errorRange(lowest, greatest, limit) },
      },
      axes: [axis("layer", { size: 30, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] }), axis("°C")],
      series: [{ label: "layer" }, series("max", 0.5, 0.5), series("min", 0.5, 0.5), series("mean", 1, 1.6)],
      bands: [{ series: [1, 2], fill: () => css("--between") }],
      hooks: { drawClear: [shadeBand], draw: [(u) => markLayers(u, limit)] },
    }, [layers.map((_, i) => i + 1), ...["max", "min", "mean"].map((key) => layers.map((l) => l[key]))]);
    bars.over.addEventListener("click", () => {
      if (bars.cursor.idx === null) return;
      showLayer(bars.cursor.idx);
      writeHash();
    });
  }

  function markLayers(u, limit) {
    u.ctx.fillStyle = css("--c-estimate");
    layers.forEach((layer, i) => {
      if (layer.max > limit) markCut(u, i + 1, 1);
      if (layer.min < -limit) markCut(u, i + 1, -1);
    });
    u.ctx.fillStyle = css("--accent");
    const x = u.valToPos(current + 1, "x", true);
    u.ctx.fillRect(x - devicePixelRatio, u.bbox.top, 2 * devicePixelRatio, u.bbox.height);
  }

  // The frame, in mm alike in both directions, is the chart's; the path is drawn into it.
  function makeView() {
    const box = byId("layer-canvas");
    const span = (u, key) => {
      const [b, ratio] = [bounds(), devicePixelRatio];
      const mmPerPixel = 1.06 * Math.max(b.w / u.bbox.width, b.h / u.bbox.height, 1 / u.bbox.width) * ratio;
      const half = ((key === "x" ? u.bbox.width : u.bbox.height) / ratio) * mmPerPixel / 2;
      const middle = key === "x" ? b.x + b.w / 2 : b.y + b.h / 2;
      return isFinite(half) && half > 0 ? [middle - half, middle + half] : [0, 1];
    };
    view = plot(box, Math.min(480, Math.max(box.clientWidth, 240)), {
      legend: { show: false }, cursor: { show: false },
      scales: { x: { time: false, range: (u) => span(u, "x") }, y: { range: (u) => span(u, "y") } },
      axes: [axis("x, mm", { size: 30 }), axis("y, mm")],
      series: [{}, { stroke: "transparent", points: { show: false } }],
      hooks: { draw: [drawPath] },
    }, [[0, 1], [0, 1]]);
  }

  const firstPoint = () => path.starts[current];
  const endPoint = () => (current + 1 < path.starts.length ? path.starts[current + 1] : path.points);

  function drawPath(u) {
    if (!path.points) return;
    const g = u.ctx, x0 = u.valToPos(0, "x", true), y0 = u.valToPos(0, "y", true);
    const scale = u.valToPos(1, "x", true) - x0;
    const x = (i) => x0 + path.px[i] * scale, y = (i) => y0 - path.py[i] * scale;
    g.save();
    g.lineWidth = devicePixelRatio * Math.max(1.2, Math.min((0.4 * scale) / devicePixelRatio, 7));
    g.lineCap = "round";
    for (let i = firstPoint() + 1; i < endPoint(); i++) {
      if (!path.ppen[i]) continue;
      g.strokeStyle = colour.palette[Math.round(colour.at(i))];
      g.beginPath();
      g.moveTo(x(i - 1), y(i - 1));
      g.lineTo(x(i), y(i));
      g.stroke();
    }
    g.restore();
  }

  function bounds() {
    let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity;
    for (let i = firstPoint(); i < endPoint(); i++) {
      x0 = Math.min(x0, path.px[i]); x1 = Math.max(x1, path.px[i]);
      y0 = Math.min(y0, path.py[i]); y1 = Math.max(y1, path.py[i]);
    }
    return { x: x0, y: y0, w: x1 - x0, h: y1 - y0 };
  }

  function describeLayer() {
    const layer = layers[current];
    const signed = (v) => (v > 0 ? "+" : "") + number(v, 2) + " °C";
    const facts = [
      ["layer", `${current + 1} of ${layers.length}, z = ${layer.z.toFixed(2)} mm`],
      ["starts at", timeText(layer.start) + (long ? "" : " s")],
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
      byId("first-chart").scrollIntoView({ behavior: "smooth" });
    });
  }

  function showLayer(index) {
    current = Math.max(0, Math.min(layers.length - 1, index));
    byId("layer-slider").value = current;
    bars.redraw(false);
    view.setData(view.data); // with the ranges of this layer
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
    makeBars();
    makeView();
    byId("layer-slider").addEventListener("input", (event) => {
      showLayer(Number(event.target.value));
      writeHash();
    });
    byId("layer-colour").addEventListener("change", (event) => {
      showColour(event.target.value);
      view.redraw(false);
      writeHash();
    });
    window.addEventListener("hashchange", readHash);
    readHash();
  }

  if (layers.length) bindLayers();
  window.addEventListener("resize", () => {
    for (const { made, box, height } of plots) made.setSize({ width: box.clientWidth, height });
    if (view) view.setData(view.data);
  });
})();
