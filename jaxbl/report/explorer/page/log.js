"use strict";
/* A log and what models make of it: over time, over one and over two coordinates, and played along the time. */

const [BINS, CELLS, DOTS, LEAST] = [60, [48, 32], 3000, 3];

/** Mean over a centred window of samples, taken twice; nan stays nan, and does not enter. */
const smoothed = (values, width) => {
  const half = Math.floor(width / 2), sums = new Float64Array(values.length + 1), counts = new Uint32Array(values.length + 1);
  let out = values;
  for (let pass = 0; pass < 2 && width > 1; pass++) {
    out.forEach((one, i) => {
      const known = Number.isFinite(one);
      [sums[i + 1], counts[i + 1]] = [sums[i] + (known ? one : 0), counts[i] + known];
    });
    out = out.map((one, i) => {
      const first = Math.max(0, i - half), last = Math.min(out.length, i + half + 1);
      return Number.isNaN(one) ? NaN : (sums[last] - sums[first]) / (counts[last] - counts[first]);
    });
  }
  return out;
};

/** Means of values in cells over coordinates, each { values, ends }; nan where there are few samples. */
const means = (values, over, size, from, to) => {
  const cells = size.reduce((a, b) => a * b), sums = new Float64Array(cells), counts = new Uint32Array(cells), shares = over.map(({ ends }) => along({ ends }).share);
  const place = (k, i) => Math.min(size[k] - 1, Math.floor(size[k] * shares[k](over[k].values[i])));
  for (let i = from; i < to; i++) {
    const cell = over.length > 1 ? place(0, i) + size[0] * place(1, i) : place(0, i);
    if (!Number.isFinite(values[i]) || !(cell >= 0)) continue;
    sums[cell] += values[i];
    counts[cell]++;
  }
  return Float32Array.from(sums, (sum, i) => (counts[i] >= LEAST ? sum / counts[i] : NaN));
};

globalThis.jaxblData = async (about) => {
  const columns = new Columns(about, 64), colours = coloursOf(about), coordinates = about.coordinates.filter((one) => one.column !== "t");
  showHead(about);
  const named = Object.fromEntries(about.coordinates.map((one) => [one.column, one]));
  // as a link has it
  const given = address.read(), shown = given.shown?.split("~");
  const view = { x: about.over[0], y: about.over[1] ?? about.over[0], part: null, at: clamped(Math.floor(given.at) || 0, 0, about.rows - 1) };
  const begin = (group) => Object.assign(view, { group, shown: group.lines.slice(0, 2).map((one) => one.column), cutoff: group.bandwidth });
  begin(about.groups.find((one) => one.name === given.group) ?? about.groups[0]);
  for (const name of ["x", "y"]) if (named[given[name]]) view[name] = given[name];
  if (shown?.every((one) => view.group.lines.some(({ column }) => column === one))) view.shown = shown;
  if (given.cutoff) view.cutoff = Number(given.cutoff) || null;
  const part = given.part?.split("~").map(Number);
  if (part?.every(Number.isFinite) && part[0] < part[1]) view.part = part;
  const remember = () => address.write({ group: view.group.name, x: view.x, y: view.y, shown: view.shown.join("~"), cutoff: view.cutoff ?? "none", part: view.part?.join("~"), at: view.at });
  const colour = (column) => COLOURS[view.group.lines.findIndex((one) => one.column === column) % COLOURS.length];
  const label = (column) => view.group.lines.find((one) => one.column === column).label;
  const axis = (column) => ({ label: named[column].label, unit: named[column].unit });

  let time, held, data = {}, plots = [], playing = null;
  /** Rows of the part that is shown. */
  const rows = () => (view.part ? [before(time, view.part[0]), Math.min(before(time, view.part[1]) + 1, time.length)] : [0, time.length]);

  const form = () => {
    const axes = coordinates.map((one) => [one.column, withUnit(one.label, one.unit)]);
    const pick = (label, id, options, chosen, act) => choose(label, id, options, chosen, (value) => { act(value); form(); redraw(); });
    const cutoffs = [...new Set([view.group.bandwidth, 200, 100, 50, 20, 10, 5, 2].filter((one) => one && one < 0.45 / about.period))].sort((a, b) => b - a);
    $("choice").replaceChildren(
      pick("what", "group", about.groups.map((one, i) => [i, withUnit(one.name, one.unit)]), about.groups.indexOf(view.group), (value) => begin(about.groups[value])),
      pick("over", "x", axes, view.x, (value) => { view.x = value; }),
      pick("and over", "y", axes, view.y, (value) => { view.y = value; }),
      pick("moving average, as a low-pass of", "cutoff", [["none", "none"], ...cutoffs.map((one) => [one, `${text(one)} Hz`])], view.cutoff ?? "none",
        (value) => { view.cutoff = value === "none" ? null : Number(value); }),
    );
    const boxes = view.group.lines.map(({ column: value }) => made("label", {}, made("input", { type: "checkbox", checked: view.shown.includes(value), value }), " ", markOf(colour(value)), label(value)));
    $("lines").replaceChildren(made("legend", { textContent: withUnit(view.group.name, view.group.unit) }), ...boxes);
  };

  const update = async () => {
    const asked = (update.asked = Symbol("asked"));
    $("state").textContent = "reading …";
    time ??= await columns.get("t", Float64Array);
    held ??= about.held ? await columns.get("held_out") : new Float32Array(about.rows);
    const needed = [...view.shown, view.x, view.y, ...coordinates.map((one) => one.column)];
    const read = await Promise.all(needed.map((name) => columns.get(name)));
    if (asked !== update.asked) return;
    data = Object.fromEntries(needed.map((name, i) => [name, read[i]]));
    // two passes of a window of n samples damp by 3 dB at 0.32 / n of the sampling rate
    const width = view.cutoff ? Math.round(0.32 / (view.cutoff * about.period)) : 1;
    for (const name of view.shown) data[name] = smoothed(data[name], width);
    draw();
    remember();
    document.body.dataset.drawn = [view.group.name, view.x, view.y, ...view.shown].join(" ");
  };
  const redraw = reporting("The log", update);

  const draw = () => {
    const [from, to] = rows(), { group, shown } = view, y = { label: group.quantity, unit: group.unit };
    const first = held.indexOf(1), bands = first < 0 ? [] : [{ low: time[first], high: time[held.lastIndexOf(1)], name: "held out" }];
    const signals = shown.map((column, i) => ({ name: label(column), x: time, y: data[column], colour: colour(column), width: i ? 1.2 : 1.8, alpha: 0.85, sorted: true }));
    const whole = new Chart($("time"), { x: axis("t"), y, height: 280, named: true, caption: `${group.name} over time`, lines: signals, shades: bands,
      range: view.part && [view.part, null], zoomed: (range) => { view.part = range && range[0]; remember(); draw(); } });
    $("overhead").textContent = `Over ${named[view.x].label}, and over ${named[view.x].label} and ${named[view.y].label}`;
    const axes = [view.x, view.y].map((name) => ({ ...axis(name), values: data[name], ends: widened(endsOf([data[name].subarray(from, to)])) })), [xs, ys] = axes.map((one) => one.values);
    const every = Math.max(1, Math.floor((to - from) / DOTS)), picked = Array.from({ length: Math.ceil((to - from) / every) }, (_, k) => from + k * every);
    const middle = (i, k, count) => along(axes[i]).value((k + 0.5) / count), middles = Float32Array.from({ length: BINS }, (_, k) => middle(0, k, BINS));
    const lines = shown.flatMap((column) => [
      { name: label(column), x: picked.map((i) => xs[i]), y: picked.map((i) => data[column][i]), colour: colour(column), alpha: 0.35, dots: 2 },
      { name: `${label(column)}: mean`, x: middles, y: means(data[column], axes.slice(0, 1), [BINS], from, to), colour: colour(column), width: 2.4, sorted: true },
    ]);
    const over = new Chart($("over1"), { x: axis(view.x), y, lines, height: 300, caption: `${group.name} over ${named[view.x].label}: samples, and means of ${BINS} bins as lines` });
    plots = [[whole, (column, i) => [time[i], data[column][i]], shown[0]], [over, (column, i) => [xs[i], data[column][i]], shown[0]]];
    const found = shown.map((column) => means(data[column], axes, CELLS, from, to));
    const sizes = found.flatMap((one) => [...one].filter(Number.isFinite).map(Math.abs)).sort((a, b) => a - b);
    const limit = sizes[Math.floor(0.98 * (sizes.length - 1))] || 1, scale = new Scale({ colours, low: -limit, high: limit, whole: [-limit, limit], label: group.quantity, unit: group.unit });
    $("over2").replaceChildren();
    found.forEach((values, k) => {
      const [x, y] = axes, saidAt = (cell) => axes.map((one, i) => saidOf(one, middle(i, cell[i], CELLS[i])));
      const said = (cell) => { const value = values[cell[1] * CELLS[0] + cell[0]]; return Number.isFinite(value) ? [`${group.quantity}: ${text(value)} ${group.unit}`, ...saidAt(cell)] : null; };
      const cells = { x: x.ends, y: y.ends, size: CELLS, text: said, colours: sheetOf(CELLS, (i) => (Number.isFinite(values[i]) ? [...scale.colour(values[i]), 255] : [...MISSING, 90])) };
      const plot = new Chart(addFigure($("over2")), { x, y, cells, height: 300, scale, caption: `${group.name}, ${label(shown[k])}: mean in each cell; grey: fewer than ${LEAST} samples` });
      plots.push([plot, (_, i) => [xs[i], ys[i]], shown[k]]);
    });
    scale.draw($("bar"));
    table(from, to);
    move(view.at);
  };

  /** Rms of each line, on the part that was fitted and on the one held out. */
  const table = (from, to) => {
    const parts = about.held ? ["used for the fit", "held out"] : ["log"];
    const sizes = (values) => means(Float64Array.from(values, (one) => one ** 2), [{ values: held, ends: [0, 2] }], [2], from, to).map(Math.sqrt);
    $("sizeshead").textContent = `Root mean square of what is shown${view.cutoff ? ", after the moving average" : ""}`;
    tableOf($("sizes"), [withUnit(view.group.name, view.group.unit), ...parts], view.shown.map((column) => [label(column), ...Array.from(sizes(data[column]).subarray(0, parts.length), text)]));
    $("state").textContent = view.part ? `From ${textBetween(view.part[0], view.part)} to ${textBetween(view.part[1], view.part)} s.` : "";
  };

  /** Marks a sample in all plots, and says what is known of it. */
  const move = (at) => {
    view.at = at;
    const [from, to] = rows(), i = clamped(at, from, to - 1);
    for (const [plot, place, column] of plots) {
      plot.mark(column && place(column, i).every(Number.isFinite) ? [[...place(column, i), "ring"]] : []);
    }
    $("moment").value = String(Math.round((1000 * (i - from)) / Math.max(to - 1 - from, 1)));
    const say = (name, value, unit) => (Number.isNaN(value) ? `${name} none` : `${name} ${text(value)} ${unit}`.trim());
    $("now").textContent = [`t ${textBetween(time[i], [time[0], time[time.length - 1]])} s`, ...coordinates.map((one) => say(one.label, data[one.column][i], one.unit)),
      ...view.shown.map((column) => say(label(column), data[column][i], view.group.unit))].join(", ");
  };
  const stop = () => {
    cancelAnimationFrame(playing);
    [playing, $("play").textContent] = [null, "play"];
  };
  $("lines").onchange = () => {
    view.shown = Array.from($("lines").querySelectorAll(":checked"), (one) => one.value);
    redraw();
  };
  $("play").onclick = () => {
    if (playing !== null) return stop();
    $("play").textContent = "pause";
    const [from, to] = rows(), start = view.at >= to - 1 || view.at < from ? from : view.at, began = performance.now();
    const step = () => {
      const now = time[start] + (Number($("speed").value) * (performance.now() - began)) / 1000, at = before(time, now);
      move(at);
      if (at >= to - 1) stop(); else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  };
  $("moment").oninput = () => {
    stop();
    const [from, to] = rows();
    move(from + Math.round((Number($("moment").value) / 1000) * (to - 1 - from)));
    remember();
  };
  $("csv").onclick = () => { const [from, to] = rows(), names = ["t", view.x, view.y, ...view.shown]; saveTable("log.csv", Object.fromEntries(names.map((name) => [name, (name === "t" ? time : data[name]).slice(from, to)]))); };
  $("picture").onclick = () => savePicture("log.png", $("drawn"));
  form();
  await redraw();
};
