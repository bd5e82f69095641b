"use strict";
/* A log and what models make of it: over time, over one and over two coordinates, and played along the time. */

const [BINS, CELLS, DOTS] = [60, [48, 32], 3000];

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

const ends = (values, from, to) => {
  const [low, high] = endsOf([values.subarray(from, to)]);
  return low < high ? [low, high] : low === high ? [low - 0.5, low + 0.5] : [0, 1];
};

/** Means of values in cells over one or two coordinates; nan where fewer than `least` samples are. */
const means = (values, over, limits, size, from, to, least) => {
  const cells = size.reduce((a, b) => a * b), sums = new Float64Array(cells), counts = new Uint32Array(cells);
  const place = (k, i) => Math.min(size[k] - 1, Math.floor((size[k] * (over[k][i] - limits[k][0])) / (limits[k][1] - limits[k][0])));
  for (let i = from; i < to; i++) {
    const across = place(0, i), up = over.length > 1 ? place(1, i) : 0;
    if (!Number.isFinite(values[i]) || !(across >= 0 && up >= 0)) continue;
    sums[across + size[0] * up] += values[i];
    counts[across + size[0] * up]++;
  }
  return Float32Array.from(sums, (sum, i) => (counts[i] >= least ? sum / counts[i] : NaN));
};

globalThis.jaxblData = async (about) => {
  const columns = new Columns(about, 64, (name, share) => { $("state").textContent = `reading ${name}: ${Math.floor(100 * share)} %`; });
  head(about);
  const colours = coloursOf(about);
  const named = Object.fromEntries(about.coordinates.map((one) => [one.column, one]));
  const view = { group: about.groups[0], x: about.over[0], y: about.over[1] ?? about.over[0], part: null, at: 0 };
  const begin = (group) => Object.assign(view, { group, shown: group.lines.slice(0, 2).map((one) => one.column), cutoff: group.bandwidth });
  begin(view.group);
  // as a link has it
  const given = address.read(), wanted = about.groups.find((one) => one.name === given.group), shown = given.shown?.split("~");
  if (wanted) begin(wanted);
  for (const name of ["x", "y"]) if (named[given[name]]) view[name] = given[name];
  if (shown?.every((one) => view.group.lines.some(({ column }) => column === one))) view.shown = shown;
  if (given.cutoff) view.cutoff = Number(given.cutoff) || null;
  const part = given.part?.split("~").map(Number);
  if (part?.every(Number.isFinite) && part[0] < part[1]) view.part = part;
  view.at = Math.max(0, Math.min(about.rows - 1, Math.floor(given.at) || 0));
  const remember = () => address.write({ group: view.group.name, x: view.x, y: view.y, shown: view.shown.join("~"), cutoff: view.cutoff ?? "none", part: view.part?.join("~"), at: view.at });
  const colour = (column) => COLOURS[view.group.lines.findIndex((one) => one.column === column) % COLOURS.length];
  const axis = (column) => ({ label: named[column].label, unit: named[column].unit });

  let time, held, data = {}, plots = [], playing = null;
  const timeAxis = axis("t");
  /** Rows of the part that is shown. */
  const rows = () => (view.part ? [before(time, view.part[0]), Math.min(before(time, view.part[1]) + 1, time.length)] : [0, time.length]);

  const form = () => {
    const coordinates = about.coordinates.filter((one) => one.column !== "t").map((one) => [one.column, withUnit(one.label, one.unit)]);
    const pick = (label, id, options, chosen, act) => choose(label, id, options, chosen, (value) => { act(value); form(); redraw(); });
    const cutoffs = [...new Set([view.group.bandwidth, 200, 100, 50, 20, 10, 5, 2].filter((one) => one && one < 0.45 / about.period))].sort((a, b) => b - a);
    $("choice").replaceChildren(
      pick("what", "group", about.groups.map((one, i) => [i, withUnit(one.name, one.unit)]), about.groups.indexOf(view.group), (value) => begin(about.groups[value])),
      pick("over", "x", coordinates, view.x, (value) => { view.x = value; }),
      pick("and over", "y", coordinates, view.y, (value) => { view.y = value; }),
      pick("moving average, as a low-pass of", "cutoff", [["none", "none"], ...cutoffs.map((one) => [one, `${text(one)} Hz`])], view.cutoff ?? "none",
        (value) => { view.cutoff = value === "none" ? null : Number(value); }),
    );
    $("lines").replaceChildren(made("legend", { textContent: withUnit(view.group.name, view.group.unit) }), ...view.group.lines.map(({ column, label }) => {
      const onchange = ({ target }) => {
        view.shown = view.group.lines.map((one) => one.column).filter((one) => (one === column ? target.checked : view.shown.includes(one)));
        redraw();
      };
      return made("label", {}, made("input", { type: "checkbox", checked: view.shown.includes(column), value: column, onchange }), " ", markOf(colour(column)), label);
    }));
  };

  const update = async () => {
    const asked = (update.asked = Symbol("asked"));
    $("state").textContent = "reading …";
    time ??= await columns.get("t", Float64Array);
    held ??= about.held ? await columns.get("held_out") : new Float32Array(about.rows);
    const needed = [...view.shown, view.x, view.y, ...about.coordinates.map((one) => one.column).filter((one) => one !== "t")];
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
    const label = (column) => group.lines.find((one) => one.column === column).label;
    const first = held.indexOf(1), bands = first < 0 ? [] : [{ low: time[first], high: time[held.lastIndexOf(1)], name: "held out" }];
    const whole = new Chart($("time"), { x: timeAxis, y, height: 280, named: true, caption: `${group.name} over time`,
      zoomed: (range) => { view.part = range && range[0]; remember(); draw(); } });
    if (view.part) whole.range = [view.part, null];
    whole.set(shown.map((column, i) => ({ name: label(column), x: time, y: data[column], colour: colour(column), width: i ? 1.2 : 1.8, alpha: 0.85, sorted: true })), bands);
    $("overhead").textContent = `Over ${named[view.x].label}, and over ${named[view.x].label} and ${named[view.y].label}`;
    const xs = data[view.x], ys = data[view.y], limits = [ends(xs, from, to), ends(ys, from, to)];
    const every = Math.max(1, Math.floor((to - from) / DOTS)), picked = [];
    for (let i = from; i < to; i += every) picked.push(i);
    const over = new Chart($("over1"), { x: axis(view.x), y, height: 300, caption: `${group.name} over ${named[view.x].label}: samples, and means of ${BINS} bins as lines` });
    const middles = Float32Array.from({ length: BINS }, (_, k) => limits[0][0] + ((k + 0.5) * (limits[0][1] - limits[0][0])) / BINS);
    over.set(shown.flatMap((column) => [
      { name: label(column), x: picked.map((i) => xs[i]), y: picked.map((i) => data[column][i]), colour: colour(column), alpha: 0.35, dots: 2 },
      { name: `${label(column)}: mean`, x: middles, y: means(data[column], [xs], limits, [BINS], from, to, 3), colour: colour(column), width: 2.4, sorted: true },
    ]));
    plots = [[whole, (column, i) => [time[i], data[column][i]], shown[0]], [over, (column, i) => [xs[i], data[column][i]], shown[0]]];
    const found = shown.map((column) => means(data[column], [xs, ys], limits, CELLS, from, to, 3));
    const sizes = found.flatMap((one) => [...one].filter(Number.isFinite).map(Math.abs)).sort((a, b) => a - b);
    const limit = sizes[Math.floor(0.98 * (sizes.length - 1))] || 1, scale = new Scale({ colours, low: -limit, high: limit, whole: [-limit, limit], label: group.quantity, unit: group.unit });
    $("over2").replaceChildren();
    found.forEach((values, k) => {
      const figure = made("figure");
      $("over2").append(figure);
      const axes = [axis(view.x), axis(view.y)].map((one, i) => ({ ...one, ends: limits[i] }));
      const plot = new Chart(figure, { x: axes[0], y: axes[1], height: 300, scale, caption: `${group.name}, ${label(shown[k])}: mean in each cell; grey: fewer than 3 samples` });
      const middle = (cell) => axes.map(({ label: name, unit }, i) => `${name}: ${text(limits[i][0] + ((cell[i] + 0.5) * (limits[i][1] - limits[i][0])) / CELLS[i])} ${unit}`.trim());
      const said = (cell) => { const value = values[cell[1] * CELLS[0] + cell[0]]; return Number.isFinite(value) ? [`${group.quantity}: ${text(value)} ${group.unit}`, ...middle(cell)] : null; };
      plot.cells = { x: limits[0], y: limits[1], size: CELLS, text: said, colours: sheetOf(CELLS, (i) => (Number.isFinite(values[i]) ? [...scale.colour(values[i]), 255] : [...MISSING, 90])) };
      plot.set([]);
      plots.push([plot, (_, i) => [xs[i], ys[i]], shown[k]]);
    });
    scale.draw($("bar"));
    table(from, to, label);
    move(view.at);
  };

  /** Rms of each line, on the part that was fitted and on the one held out. */
  const table = (from, to, label) => {
    const parts = about.held ? [["used for the fit", 0], ["held out", 1]] : [["log", 0]];
    const rms = (values, which) => {
      let [sum, count] = [0, 0];
      for (let i = from; i < to; i++) if (held[i] === which && Number.isFinite(values[i])) { sum += values[i] ** 2; count++; }
      return count ? Math.sqrt(sum / count) : NaN;
    };
    $("sizeshead").textContent = `Root mean square of what is shown${view.cutoff ? ", after the moving average" : ""}`;
    tableOf($("sizes"), [withUnit(view.group.name, view.group.unit), ...parts.map(([name]) => name)], view.shown.map((column) => [label(column), ...parts.map(([, which]) => text(rms(data[column], which)))]));
    $("state").textContent = view.part ? `From ${textBetween(view.part[0], view.part)} to ${textBetween(view.part[1], view.part)} s.` : "";
  };

  /** Marks a sample in all plots, and says what is known of it. */
  const move = (at) => {
    view.at = at;
    const [from, to] = rows(), i = Math.min(Math.max(at, from), to - 1);
    for (const [plot, place, column] of plots) {
      plot.marks = column && place(column, i).every(Number.isFinite) ? [[...place(column, i), "ring"]] : [];
      plot.draw();
    }
    $("moment").value = String(Math.round((1000 * (i - from)) / Math.max(to - 1 - from, 1)));
    const say = (name, value, unit) => (Number.isNaN(value) ? `${name} none` : `${name} ${text(value)} ${unit}`.trim());
    $("now").textContent = [`t ${textBetween(time[i], [time[0], time[time.length - 1]])} s`, ...about.coordinates.filter((one) => one.column !== "t").map((one) => say(one.label, data[one.column][i], one.unit)),
      ...view.shown.map((column) => say(view.group.lines.find((one) => one.column === column).label, data[column][i], view.group.unit))].join(", ");
  };
  const stop = () => {
    cancelAnimationFrame(playing);
    [playing, $("play").textContent] = [null, "play"];
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
