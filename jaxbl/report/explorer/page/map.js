"use strict";
/* A study as maps: what is drawn over which axes, values under the pointer, regions, cuts, gain conditions, and runs simulated anew. */

/** A study: its axes as dimensions of an array, and its columns. */
class Study {
  constructor(about) {
    Object.assign(this, about);
    // of very many rows few columns fit into memory
    this.columns = new Columns(about, 8, (name, share) => { $("state").textContent = `reading ${name}: ${Math.floor(100 * share)} %`; });
    this.dims = about.axes.map((axis, i) => ({
      i, size: axis.paths[0].values.length, paths: axis.paths, name: axis.paths.map((one) => one.path).join(", "),
      unit: axis.paths[0].unit, values: axis.paths[0].values, seed: axis.paths[0].path === "seed",
      // of axes that advance together an axis has room for the first one's values
      label: [withUnit(axis.paths[0].path, axis.paths[0].unit), ...axis.paths.slice(1).map((one) => `with ${one.path}`)].join(", "),
      said: (k) => axis.paths.map(({ values, unit }) => `${text(values[k])} ${unit}`.trim()).join(", "),
    }));
    this.colours = coloursOf(about);
    let stride = 1;
    for (const dim of [...this.dims].reverse()) { dim.stride = stride; stride *= dim.size; }
    this.varied = this.dims.filter((dim) => dim.size > 1);
  }
  /** Paths of what varies, but for the seed. */
  get named() { return this.varied.filter((dim) => !dim.seed).flatMap((dim) => dim.paths.map((one) => one.path)); }
  metric(name) { return this.metrics.find((one) => one.name === name); }
  column(name) { return this.columns.get(name); }
}

/** One number of several, nan left out. */
const reduced = {
  median: (values) => {
    if (!values.length) return NaN;
    values.sort();
    const middle = values.length >> 1;
    return values.length % 2 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
  },
  mean: (values) => (values.length ? values.reduce((a, b) => a + b, 0) / values.length : NaN),
  least: (values) => (values.length ? values.reduce((a, b) => Math.min(a, b)) : NaN),
  largest: (values) => (values.length ? values.reduce((a, b) => Math.max(a, b)) : NaN),
};

/** The map of a view: values (rows of y) of cells, each of one or more points along x and y. */
const mapped = (study, column, view) => {
  const { x, y, from, to, most } = view;
  const size = [to[0] - from[0], to[1] - from[1]], step = size.map((one, i) => Math.ceil(one / most[i]));
  const cells = size.map((one, i) => Math.ceil(one / step[i]));
  const others = study.dims.filter((dim) => dim !== x && dim !== y && dim.size > 1);
  // where points lie that a cell is made of
  let offsets = [0];
  for (const dim of others) {
    const at = view.at[dim.i];
    const along = at === "all" ? Array.from({ length: dim.size }, (_, i) => i * dim.stride) : [at * dim.stride];
    offsets = offsets.flatMap((one) => along.map((more) => one + more));
  }
  const out = new Float32Array(cells[0] * cells[1]);
  const gathered = new Float32Array(offsets.length * step[0] * step[1]);
  // of what is true or false, the share
  const how = study.metric(view.metric).yes ? reduced.mean : reduced[view.how];
  for (let j = 0; j < cells[1]; j++) {
    for (let i = 0; i < cells[0]; i++) {
      let count = 0;
      for (let b = from[1] + j * step[1]; b < Math.min(from[1] + (j + 1) * step[1], to[1]); b++) {
        for (let a = from[0] + i * step[0]; a < Math.min(from[0] + (i + 1) * step[0], to[0]); a++) {
          const base = a * x.stride + b * y.stride;
          for (let k = 0; k < offsets.length; k++) {
            const value = column[base + offsets[k]];
            if (value === value) gathered[count++] = value;
          }
        }
      }
      out[j * cells[0] + i] = count === 1 ? gathered[0] : how(gathered.subarray(0, count));
    }
  }
  return { values: out, cells, step };
};

/* ---------------------------------------------------------------------------------------------------------- drawing */

const MARGIN = { left: 78, right: 18, top: 26, bottom: 52 }, BAR = 100, MOST_FACETS = 6;

/** The map of a metric over two axes, or one of each value of a third axis. */
class Picture {
  constructor(study) {
    this.study = study;
    this.canvas = $("map");
    this.over = $("over");
    const [y, x] = [study.dims[study.overview.y], study.dims[study.overview.x]];
    this.view = { x, y, facet: null, metric: study.first, how: "median", log: true, at: study.dims.map((dim) => (dim.seed ? "all" : 0)) };
    this.whole();
    this.cursor = null;
    this.curved = [];
  }
  whole() { Object.assign(this.view, { from: [0, 0], to: [this.view.x.size, this.view.y.size] }); }
  /** Which values of the facet are drawn: all, or some of many. */
  facets() {
    const { facet } = this.view;
    if (!facet) return [null];
    const count = Math.min(facet.size, MOST_FACETS);
    return Array.from({ length: count }, (_, k) => Math.round((k * (facet.size - 1)) / Math.max(count - 1, 1)));
  }
  /** The view of a panel: at its value of the facet. */
  viewed(index) {
    if (index === null) return this.view;
    return { ...this.view, at: this.view.at.map((one, i) => (i === this.view.facet.i ? index : one)) };
  }
  /** Sizes in pixels, and where each panel lies. */
  fit() {
    const facets = this.facets(), columns = facets.length > 1 ? Math.min(facets.length === 4 ? 2 : 3, facets.length) : 1;
    this.width = $("plot").clientWidth;
    const wide = (this.width - BAR) / columns, high = facets.length > 1 ? Math.min(0.85 * wide, 460) : Math.round(Math.min(0.62 * this.width, 640));
    this.height = Math.round(high * Math.ceil(facets.length / columns));
    this.panels = facets.map((index, k) => ({
      index,
      title: index === null ? "" : `${this.view.facet.name} = ${this.view.facet.said(index)}`,
      box: {
        left: (k % columns) * wide + MARGIN.left, top: Math.floor(k / columns) * high + MARGIN.top,
        width: wide - MARGIN.left - MARGIN.right, height: high - MARGIN.top - MARGIN.bottom,
      },
    }));
    for (const canvas of [this.canvas, this.over]) {
      const density = devicePixelRatio || 1;
      canvas.width = this.width * density;
      canvas.height = this.height * density;
      canvas.style.width = `${this.width}px`;
      canvas.style.height = `${this.height}px`;
      canvas.getContext("2d").setTransform(density, 0, 0, density, 0, 0);
    }
    const { box } = this.panels[0];
    this.view.most = [Math.max(box.width, 1), Math.max(box.height, 1)].map((one) => Math.min(one, 1024));
  }
  async update() {
    const asked = (this.asked = Symbol("asked"));
    $("state").textContent = "reading …";
    const column = await this.study.column(this.view.metric);
    const bounds = this.bounds() && (await this.study.column(this.bounds()));
    // a later choice was faster
    if (asked !== this.asked) return;
    this.column = column;
    this.fit();
    for (const panel of this.panels) panel.shown = mapped(this.study, column, this.viewed(panel.index));
    this.curved = bounds ? this.panels.map((panel) => this.curve(bounds, panel)) : [];
    await this.hatch();
    if (asked !== this.asked) return;
    this.draw();
    const { facet } = this.view, some = facet && facet.size > this.panels.length ? `${this.panels.length} of ${facet.size} values of ${facet.name}. ` : "";
    $("state").textContent = some + (this.study.found < this.study.rows ? `${this.study.found} of ${this.study.rows} runs so far.${this.study.served ? " Load the page again for more." : ""} ` : "") + this.told();
    document.body.dataset.drawn = [this.view.metric, this.view.x.name, this.view.y.name, facet?.name].filter(Boolean).join(" ");
  }
  /** From what the export computed, before any column is read. */
  first() {
    const { overview } = this.study;
    this.fit();
    const step = overview.shape.map((one, i) => Math.ceil([this.view.y.size, this.view.x.size][i] / one));
    this.panels[0].shown = { values: unpacked(overview.values), cells: [...overview.shape].reverse(), step: step.reverse() };
    this.draw();
    document.body.dataset.drawn = "overview";
  }
  /** Colours of values, one scale for all panels. */
  scale() {
    const { log, metric } = this.view, { label, yes } = this.study.metric(metric);
    let values = this.panels.flatMap(({ shown }) => [...shown.values]);
    // a scale of logarithms has no place for zeros, and none for a sign
    const positive = log && !yes && !values.some((one) => one < 0) ? values.filter((one) => one > 0) : [];
    if (positive.length) values = positive;
    return Scale.of(values, { colours: this.study.colours, label, ...(yes ? { low: 0, high: 1 } : {}), ...(log && !yes ? {} : { log: false }) });
  }
  draw() {
    const context = this.canvas.getContext("2d"), style = getComputedStyle(document.body);
    context.fillStyle = style.backgroundColor;
    context.fillRect(0, 0, this.width, this.height);
    const scale = (this.scaled = this.scale()), { top, height } = this.panels[0].box;
    for (const panel of this.panels) {
      this.cells(context, panel, scale);
      this.axes(context, panel, style.color);
    }
    scale.draw(context, style.color, this.width - BAR + 10, top, height);
    const over = `${this.view.x.name} and ${this.view.y.name}${this.view.facet ? `, for values of ${this.view.facet.name}` : ""}`;
    this.canvas.setAttribute("aria-label", `${this.label()} over ${over}: ${scale.said}`);
    this.mark();
  }
  cells(context, { box, shown: { cells, values, step }, failed }, scale) {
    context.imageSmoothingEnabled = false;
    // the last cell may have fewer points than the others
    const size = this.size(), reach = cells.map((one, i) => (one * step[i]) / size[i]);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    const place = [box.left, box.top + box.height * (1 - reach[1]), box.width * reach[0], box.height * reach[1]];
    context.drawImage(sheetOf(cells, (k) => [...scale.colour(values[k]), 255]), ...place);
    if (this.hatched) {
      // strokes where the mask is
      const strokes = Object.assign(document.createElement("canvas"), { width: this.width, height: this.height }), own = strokes.getContext("2d");
      own.imageSmoothingEnabled = false;
      own.strokeStyle = "#ffffffb0";
      own.beginPath();
      for (let k = -box.height; k < box.width; k += 9) { own.moveTo(box.left + k, box.top + box.height); own.lineTo(box.left + k + box.height, box.top); }
      own.stroke();
      own.globalCompositeOperation = "destination-in";
      own.drawImage(sheetOf(cells, (k) => (failed[k] < 0.5 ? [0, 0, 0, 255] : null)), ...place);
      context.drawImage(strokes, 0, 0);
    }
    context.restore();
  }
  /** Cells of a side's metrics in which its observer did not converge, in most runs. */
  async hatch() {
    const name = `${this.view.metric.split(".")[0]}.converged`, known = this.study.metric(name) && this.view.metric !== name;
    const column = known ? await this.study.column(name) : null;
    for (const panel of this.panels) panel.failed = column && mapped(this.study, column, { ...this.viewed(panel.index), metric: name }).values;
    this.hatched = this.panels.some(({ failed }) => failed?.some((one) => one < 0.5));
  }
  /** The column with the bound f_plus that a gain condition is drawn for, if one is asked for. */
  bounds() {
    const side = this.gains(), { condition } = this.view;
    return side && condition && condition !== "none" ? `${side}.f_plus` : null;
  }
  /** Least lambda over alpha of a condition, at a panel's median f_plus. */
  curve(column, { index }) {
    const metric = this.bounds(), values = mapped(this.study, column, { ...this.viewed(index), metric, how: "median" }).values.filter(Number.isFinite);
    const bound = reduced.median(values), { alpha, lambda } = this.study.conditions.find((one) => one.name === this.view.condition);
    const points = bound > 0 ? alpha.map((one, i) => [one * bound, lambda[i] * Math.sqrt(bound)]) : [];
    return { bound, points: this.view.x.name.endsWith(".alpha") ? points : points.map(([a, b]) => [b, a]) };
  }
  told() {
    const hatched = this.hatched ? `Hatched: the ${this.view.metric.split(".")[0]} observer did not converge${this.view.at.includes("all") ? " in most runs" : ""}. ` : "";
    const known = this.curved.map(({ bound }) => bound).filter((one) => one > 0);
    return hatched + (known.length ? `f⁺ = ${[...new Set(known.map(text))].join("; ")} rad/s²: the median of what is shown.` : "");
  }
  /** The side whose gains the axes are, if they are, from small to large. */
  gains() {
    if ([this.view.x, this.view.y].some(({ values }) => values.some((one, k) => k && !(one > values[k - 1])))) return null;
    const [a, b] = [this.view.x.name, this.view.y.name].sort(), side = a.split(".")[1];
    const both = a === `observer.${side}.alpha` && b === `observer.${side}.lambda`;
    return both && this.study.metric(`${side}.f_plus`) ? side : null;
  }
  /** Where a value lies along an axis, as a share of the map; between two values in the axis's own scale. */
  share(i, value) {
    const { values } = [this.view.x, this.view.y][i], log = values[0] > 0 && values[values.length - 1] / values[0] > 20;
    const map = log ? Math.log : (one) => one, count = values.length;
    let k = values.findIndex((one) => one >= value);
    if (k < 0) k = count - 1;
    k = Math.max(1, k);
    const at = k - 1 + (map(value) - map(values[k - 1])) / (map(values[k]) - map(values[k - 1]));
    return (at + 0.5 - this.view.from[i]) / this.size()[i];
  }
  size() { return [0, 1].map((i) => this.view.to[i] - this.view.from[i]); }
  label() { return this.study.metric(this.view.metric).label; }
  axes(context, { box, title }, colour) {
    const { view } = this;
    context.fillStyle = colour;
    context.font = "13px system-ui, sans-serif";
    const size = this.size();
    [view.x, view.y].forEach((dim, i) => {
      const every = Math.max(1, Math.ceil(size[i] / (i ? box.height / 40 : box.width / 90)));
      for (let k = view.from[i]; k < view.to[i]; k += every) {
        const share = (k - view.from[i] + 0.5) / size[i];
        context.textAlign = i ? "right" : "center";
        context.textBaseline = i ? "middle" : "top";
        if (i) context.fillText(text(dim.values[k]), box.left - 8, box.top + box.height * (1 - share));
        else context.fillText(text(dim.values[k]), box.left + box.width * share, box.top + box.height + 8);
      }
      context.save();
      context.textAlign = "center";
      if (i) { context.translate(box.left - MARGIN.left + 14, box.top + box.height / 2); context.rotate(-Math.PI / 2); context.fillText(dim.label, 0, 0, box.height + 40); }
      else context.fillText(dim.label, box.left + box.width / 2, box.top + box.height + 30, box.width + 40);
      context.restore();
    });
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.fillText(title, box.left, box.top - 8, box.width);
  }
  /** What lies at a place in pixels: the panel's number, and the cell's indices along both axes; null outside. */
  at([px, py]) {
    for (const [panel, { box }] of this.panels.entries()) {
      const shares = [(px - box.left) / box.width, 1 - (py - box.top) / box.height];
      if (shares.every((one) => one >= 0 && one < 1)) {
        return { panel, cell: shares.map((one, i) => this.view.from[i] + Math.floor(one * this.size()[i])) };
      }
    }
    return null;
  }
  lines({ panel, cell }) {
    const { shown, title } = this.panels[panel];
    const at = cell.map((one, i) => Math.floor((one - this.view.from[i]) / shown.step[i]));
    const places = [this.view.x, this.view.y].map((dim, i) => `${dim.name}: ${dim.said(cell[i])}`);
    return [`${this.label()}: ${text(shown.values[at[1] * shown.cells[0] + at[0]])}`, ...places, ...(title ? [title] : [])];
  }
  /** What is drawn over the maps: conditions, the region that is being drawn, the chosen cell. */
  mark() {
    const context = this.over.getContext("2d");
    context.clearRect(0, 0, this.width, this.height);
    this.panels.forEach(({ box }, k) => {
      const points = this.curved[k]?.points ?? [];
      context.save();
      context.beginPath();
      context.rect(box.left, box.top, box.width, box.height);
      context.clip();
      this.outlined(context, ["#FFD400", 2], ["#000000", 4], () => {
        for (const [a, b] of points) context.lineTo(box.left + box.width * this.share(0, a), box.top + box.height * (1 - this.share(1, b)));
      });
      context.restore();
      if (this.cursor?.panel !== k) return;
      const size = this.size(), shares = this.cursor.cell.map((one, i) => (one - this.view.from[i] + 0.5) / size[i]);
      if (shares.some((one) => one < 0 || one > 1)) return;
      const place = [box.left + box.width * shares[0], box.top + box.height * (1 - shares[1])];
      this.outlined(context, ["#ffffff", 3], ["#000000", 6], () => context.arc(...place, 6, 0, 2 * Math.PI));
    });
    if (this.brush) {
      const [[ax, ay], [bx, by]] = this.brush;
      this.outlined(context, ["#000000", 1], ["#ffffff", 3], () => context.rect(Math.min(ax, bx), Math.min(ay, by), Math.abs(ax - bx), Math.abs(ay - by)));
    }
  }
  outlined(context, inner, outer, path) {
    for (const [colour, width] of [outer, inner]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      path();
      context.stroke();
    }
  }
  /** The point of the chosen cell: values by path, the seed, and what is stored of the metric; of what is taken together, the first. */
  point() {
    const { x, y, at } = this.viewed(this.panels[this.cursor.panel].index), values = {};
    const indices = this.study.dims.map((dim) => (dim === x ? this.cursor.cell[0] : dim === y ? this.cursor.cell[1] : at[dim.i] === "all" ? 0 : at[dim.i]));
    for (const dim of this.study.dims) for (const one of dim.paths) values[one.path] = one.values[indices[dim.i]];
    const { seed, ...others } = values, row = this.study.dims.reduce((sum, dim) => sum + indices[dim.i] * dim.stride, 0);
    return { values: others, seed, stored: { metric: this.study.metric(this.view.metric), value: this.column[row] } };
  }
}

/** Lines over each axis, through the chosen cell. */
const cut = (element, picture, i) => {
  const { study, view, cursor: { cell, panel } } = picture, dim = [view.x, view.y][i];
  const along = { ...picture.viewed(picture.panels[panel].index), from: [...cell], to: cell.map((one) => one + 1), most: [1e9, 1e9] };
  along.from[i] = 0;
  along.to[i] = dim.size;
  const { values } = mapped(study, picture.column, along), finite = values.filter(Number.isFinite);
  const log = picture.scaled.log && reduced.largest(finite) > 10 * reduced.least(finite);
  const plot = new Plot(element, { x: { label: dim.label, names: dim.values.map(text) }, y: { label: picture.label(), log }, height: 270 });
  plot.set([{ name: "", x: values.map((_, k) => k), y: values, colour: COLOURS[1], width: 2, marks: [cell[i]], sorted: true }]);
  return plot;
};

/* ------------------------------------------------------------------------------------------------------------ page */

globalThis.jaxblData = async (about) => {
  const study = new Study(about);
  head(about);
  const picture = new Picture(study), { view } = picture, plot = $("plot");
  const runs = about.served ? new Runs(study) : null, update = reporting("The study's points", () => picture.update());
  let chosen = null;
  $("hint").textContent = `Move over the map to read values. Drag to enlarge a region. Click a cell to cut through it${runs ? " and to simulate its run" : ""}. Grey: no value, as the run diverged, is not there yet, or has no such number.`;
  const form = () => {
    const dims = study.varied.filter((dim) => !dim.seed), drawn = () => [view.x, view.y, view.facet];
    const changed = (act) => (value) => { act(value); form(); update(); };
    const pick = (label, id, options, chosen, act) => choose(label, id, options, chosen, changed(act));
    const forget = () => {
      picture.cursor = null;
      $("chosen").hidden = true;
      picture.whole();
    };
    const swap = (name) => (value) => {
      const dim = study.dims[value], other = ["x", "y", "facet"].find((one) => one !== name && view[one] === dim);
      if (other) view[other] = view[name];
      view[name] = dim;
      forget();
    };
    $("choice").replaceChildren(
      pick("metric", "metric", study.metrics.map((one) => [one.name, one.label]), view.metric, (value) => { view.metric = value; }),
      pick("x", "x", dims.map((dim) => [dim.i, dim.name]), view.x.i, swap("x")),
      pick("y", "y", dims.map((dim) => [dim.i, dim.name]), view.y.i, swap("y")),
      ...(dims.length > 2 ? [pick("side by side", "facet", [["none", "none"], ...dims.filter((dim) => dim !== view.x && dim !== view.y).map((dim) => [dim.i, dim.name])],
        view.facet?.i ?? "none", (value) => { view.facet = study.dims[value] ?? null; forget(); })] : []),
      ...study.varied.filter((dim) => !drawn().includes(dim)).map((dim) =>
        pick(dim.name, `at${dim.i}`, [["all", "all"], ...dim.values.map((_, i) => [i, dim.said(i)])], view.at[dim.i],
          (value) => { view.at[dim.i] = value === "all" ? value : Number(value); })),
      pick("of several", "how", Object.keys(reduced).map((one) => [one, one]), view.how, (value) => { view.how = value; }),
      ...(picture.gains() ? [pick("gain condition", "condition", [["none", "none"], ...study.conditions.map((one) => [one.name, one.title])], view.condition ?? "none",
        (value) => { view.condition = value; })] : []),
      pick("colours", "log", [["true", "logarithmic where it fits"], ["false", "linear"]], view.log, (value) => { view.log = value === "true"; }),
    );
  };
  form();
  const at = (event) => {
    const box = plot.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const show = (found, place) => {
    const values = $("values");
    values.hidden = !found;
    if (!found) return;
    values.textContent = picture.lines(found).join("\n");
    beside(values, place, plot);
  };
  const take = (found) => {
    picture.cursor = found;
    picture.mark();
    $("chosen").hidden = false;
    chosen = picture.point();
    const { values, seed, stored } = chosen;
    picture.cuts = [cut($("cutx"), picture, 0), cut($("cuty"), picture, 1)];
    const together = study.varied.filter((dim) => ![view.x, view.y, view.facet].includes(dim) && view.at[dim.i] === "all");
    const several = together.filter((dim) => !dim.seed || runs), taken = together.length && !study.metric(view.metric).yes ? ` (${view.how})` : "";
    const seeds = runs && !several.some((dim) => dim.seed) ? `, seed ${seed}` : "";
    $("where").textContent = `${picture.lines(found)[0]}${taken} at ${pointWords(study.varied.filter((dim) => !dim.seed).flatMap((dim) => dim.paths), values)}${seeds}`;
    const first = several.length ? ` It is the run of the first value of ${several.map((dim) => dim.name).join(", ")}.` : "";
    $("command").textContent = (runs ? "" : "Save the point beside study.toml, and simulate it: jaxbl simulate point.toml.") + first;
    runs?.simulate(values, seed, stored);
  };
  plot.addEventListener("pointerdown", (event) => { if (picture.column) { picture.brush = [at(event), at(event)]; plot.setPointerCapture(event.pointerId); } });
  plot.addEventListener("pointermove", (event) => {
    // the first picture has not all points
    if (!picture.column) return;
    if (picture.brush) { picture.brush[1] = at(event); picture.mark(); }
    show(picture.at(at(event)), at(event));
  });
  plot.addEventListener("pointerup", () => {
    const { brush } = picture;
    picture.brush = null;
    if (!brush) return;
    const [a, b] = brush.map((place) => picture.at(place));
    if (a && b && a.panel === b.panel && Math.hypot(brush[0][0] - brush[1][0], brush[0][1] - brush[1][1]) > 8) {
      view.from = [0, 1].map((i) => Math.min(a.cell[i], b.cell[i]));
      view.to = [0, 1].map((i) => Math.max(a.cell[i], b.cell[i]) + 1);
      update();
    } else if (a) take(a);
    picture.mark();
  });
  plot.addEventListener("pointerleave", () => show(null));
  plot.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (step && picture.column) {
      const { panel, cell } = picture.cursor ?? { panel: 0, cell: [0, 1].map((i) => (view.from[i] + view.to[i]) >> 1) };
      picture.cursor = { panel, cell: cell.map((one, i) => Math.min(view.to[i] - 1, Math.max(view.from[i], one + step[i]))) };
      picture.mark();
      $("state").textContent = picture.lines(picture.cursor).join("; ");
    } else if (event.key === "Enter" && picture.cursor) take(picture.cursor);
    else if (event.key === "0") { picture.whole(); update(); }
    else return;
    event.preventDefault();
  });
  $("whole").addEventListener("click", () => { picture.whole(); update(); });
  $("picture").addEventListener("click", () => save("map.png", picture.canvas.toDataURL("image/png")));
  $("point").addEventListener("click", () => saveText("point.toml", runs ? runs.config() : pointText(chosen.values, study.effects)));
  $("gains").addEventListener("click", () => saveText("gains.toml", gainsText(study.gains, chosen.values)));
  addEventListener("resize", () => { update(); for (const one of [...(picture.cuts ?? []), ...(runs?.plots ?? [])]) one.draw(); });
  picture.first();
  await update();
};
