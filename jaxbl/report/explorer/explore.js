"use strict";
/* A study as a map: what is drawn over which axes, values under the pointer, regions, cuts. Reads points.parquet by columns. */

const $ = (id) => document.getElementById(id);
const made = (tag, properties = {}, ...children) => {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
};
const text = (value) => {
  if (typeof value === "string") return value;
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(3) : String(Number(value.toPrecision(4)));
};

/* ------------------------------------------------------------------------------------------------------------- data */

const waiting = new Map();
/** Called by the scripts that carry the Parquet file for pages opened from disk. */
globalThis.jaxblBytes = (number, content) => {
  waiting.get(number)(Uint8Array.from(atob(content), (one) => one.charCodeAt(0)));
};

/** The Parquet file as hyparquet reads it: its length, and bytes from and to. */
const bytesOf = (about) => {
  const kept = new Map();
  const script = (number) => {
    if (!kept.has(number)) {
      kept.set(number, new Promise((resolve, reject) => {
        waiting.set(number, resolve);
        const element = made("script", { src: `points.${String(number).padStart(4, "0")}.js`, onerror: () => reject(new Error(`${element.src} is missing`)) });
        document.head.append(element);
      }));
    }
    return kept.get(number);
  };
  const fromScripts = async (start, end) => {
    const first = Math.floor(start / about.script), last = Math.floor((end - 1) / about.script);
    const parts = await Promise.all(Array.from({ length: last - first + 1 }, (_, i) => script(first + i)));
    const out = new Uint8Array(end - start);
    parts.forEach((part, i) => {
      const begin = (first + i) * about.script, from = Math.max(start, begin), to = Math.min(end, begin + part.length);
      out.set(part.subarray(from - begin, to - begin), from - start);
    });
    return out.buffer;
  };
  let whole = null;
  const byRange = async (start, end) => {
    if (whole) return (await whole).slice(start, end);
    const answer = await fetch("points.parquet", { headers: { Range: `bytes=${start}-${end - 1}` } });
    if (!answer.ok) throw new Error(`points.parquet: ${answer.status} ${answer.statusText}`);
    if (answer.status === 206) return answer.arrayBuffer();
    // some servers send the whole file, which is enough once
    whole ??= answer.arrayBuffer();
    return (await whole).slice(start, end);
  };
  const slice = location.protocol === "file:" ? fromScripts : byRange;
  return { byteLength: about.bytes, slice: (start, end = about.bytes) => slice(start, end) };
};

class Study {
  constructor(about) {
    Object.assign(this, about);
    this.file = bytesOf(about);
    this.kept = new Map();
    this.dims = about.axes.map((axis, i) => ({
      i, size: axis.paths[0].values.length, paths: axis.paths, name: axis.paths.map((one) => one.path).join(", "),
      unit: axis.paths[0].unit, values: axis.paths[0].values,
    }));
    let stride = 1;
    for (const dim of [...this.dims].reverse()) { dim.stride = stride; stride *= dim.size; }
    this.varied = this.dims.filter((dim) => dim.size > 1);
  }
  metric(name) { return this.metrics.find((one) => one.name === name); }
  /** A column as Float32Array. */
  column(name) {
    if (!this.kept.has(name)) {
      // of very many rows few columns fit into memory
      if (this.kept.size >= 8) this.kept.delete(this.kept.keys().next().value);
      this.kept.set(name, this.read(name));
    }
    return this.kept.get(name);
  }
  async read(name) {
    this.metadata ??= hyparquet.parquetMetadataAsync(this.file);
    const metadata = await this.metadata, out = new Float32Array(this.rows);
    let rowStart = 0;
    for (const group of metadata.row_groups) {
      const rowEnd = rowStart + Number(group.num_rows);
      // the page stays alive
      await new Promise((resolve) => setTimeout(resolve));
      $("state").textContent = `reading ${name}: ${Math.floor((100 * rowStart) / this.rows)} %`;
      await hyparquet.parquetRead({
        file: this.file, metadata, columns: [name], rowStart, rowEnd,
        onChunk: ({ columnData, rowStart: first }) => out.set(columnData, first),
      });
      rowStart = rowEnd;
    }
    return out;
  }
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

const MARGIN = { left: 78, right: 96, top: 12, bottom: 52 };

class Picture {
  constructor(study) {
    this.study = study;
    this.canvas = $("map");
    this.over = $("over");
    const [y, x] = [study.dims[study.overview.y], study.dims[study.overview.x]];
    this.view = { x, y, metric: study.first, how: "median", log: true, at: study.dims.map((dim) => (dim.paths[0].path === "seed" ? "all" : 0)) };
    this.whole();
    this.cursor = null;
  }
  whole() { Object.assign(this.view, { from: [0, 0], to: [this.view.x.size, this.view.y.size] }); }
  get box() {
    return { left: MARGIN.left, top: MARGIN.top, width: this.width - MARGIN.left - MARGIN.right, height: this.height - MARGIN.top - MARGIN.bottom };
  }
  fit() {
    this.width = $("plot").clientWidth;
    this.height = Math.round(Math.min(0.62 * this.width, 640));
    for (const canvas of [this.canvas, this.over]) {
      const density = devicePixelRatio || 1;
      canvas.width = this.width * density;
      canvas.height = this.height * density;
      canvas.style.width = `${this.width}px`;
      canvas.style.height = `${this.height}px`;
      canvas.getContext("2d").setTransform(density, 0, 0, density, 0, 0);
    }
    this.view.most = [Math.max(this.box.width, 1), Math.max(this.box.height, 1)].map((one) => Math.min(one, 1024));
  }
  async update() {
    this.fit();
    $("state").textContent = "reading …";
    const asked = (this.asked = Symbol("asked"));
    const column = await this.study.column(this.view.metric);
    // a later choice was faster
    if (asked !== this.asked) return;
    this.column = column;
    this.shown = mapped(this.study, column, this.view);
    await this.curves();
    this.draw();
    $("state").textContent = this.study.found < this.study.rows ? `${this.study.found} of ${this.study.rows} runs so far` : "";
    if (this.curved.length) $("state").textContent += ` f⁺ = ${text(this.bound)} rad/s²: the view's median`;
    document.body.dataset.drawn = `${this.view.metric} ${this.view.x.name} ${this.view.y.name}`;
  }
  /** From what the export computed, before any column is read. */
  first() {
    const { overview } = this.study;
    this.fit();
    const bytes = Uint8Array.from(atob(overview.values), (one) => one.charCodeAt(0));
    const step = overview.shape.map((one, i) => Math.ceil([this.view.y.size, this.view.x.size][i] / one));
    this.shown = { values: new Float32Array(bytes.buffer), cells: [...overview.shape].reverse(), step: step.reverse() };
    this.draw();
    document.body.dataset.drawn = "overview";
  }
  scale() {
    const finite = this.shown.values.filter((one) => Number.isFinite(one) && (!this.view.log || one > 0));
    let low = Infinity, high = -Infinity;
    for (const one of finite) { low = Math.min(low, one); high = Math.max(high, one); }
    if (this.study.metric(this.view.metric).yes) [low, high] = [0, 1];
    if (!(low < high)) [low, high] = [low - 0.5 * Math.abs(low) - 1e-12, high + 0.5 * Math.abs(high) + 1e-12];
    this.log = this.view.log && low > 0 && high / low > 30;
    const map = this.log ? Math.log : (one) => one;
    return { low, high, share: (one) => (map(one) - map(low)) / (map(high) - map(low)), value: (share) => (this.log ? low * (high / low) ** share : low + share * (high - low)) };
  }
  draw() {
    const context = this.canvas.getContext("2d"), { box } = this, { cells, values } = this.shown;
    const style = getComputedStyle(document.body);
    context.fillStyle = style.backgroundColor;
    context.fillRect(0, 0, this.width, this.height);
    const image = new ImageData(cells[0], cells[1]), scale = (this.scaled = this.scale());
    const colours = this.study.colours.map((one) => [1, 3, 5].map((i) => parseInt(one.slice(i, i + 2), 16)));
    for (let j = 0; j < cells[1]; j++) {
      for (let i = 0; i < cells[0]; i++) {
        const value = values[j * cells[0] + i], at = 4 * ((cells[1] - 1 - j) * cells[0] + i);
        const share = Number.isFinite(value) ? Math.min(1, Math.max(0, scale.share(value))) : NaN;
        const colour = share === share ? colours[Math.round(255 * share)] : [189, 189, 189];
        image.data.set([...colour, 255], at);
      }
    }
    const sheet = Object.assign(document.createElement("canvas"), { width: cells[0], height: cells[1] });
    sheet.getContext("2d").putImageData(image, 0, 0);
    context.imageSmoothingEnabled = false;
    // the last cell may have fewer points than the others
    const size = this.size(), reach = cells.map((one, i) => (one * this.shown.step[i]) / size[i]);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    context.drawImage(sheet, box.left, box.top + box.height * (1 - reach[1]), box.width * reach[0], box.height * reach[1]);
    context.restore();
    this.axes(context, style.color);
    this.bar(context, colours, style.color);
    this.canvas.setAttribute("aria-label", `${this.label()} over ${this.view.x.name} and ${this.view.y.name}, from ${text(scale.low)} to ${text(scale.high)}`);
    this.mark();
  }
  /** Least lambda over alpha of the conditions asked for, at the view's median f_plus. */
  async curves() {
    this.curved = [];
    const { x, y, condition } = this.view, side = this.gains();
    if (!side || !condition || condition === "none") return;
    const bounds = mapped(this.study, await this.study.column(`${side}.f_plus`), { ...this.view, metric: `${side}.f_plus`, how: "median" }).values.filter(Number.isFinite);
    const bound = reduced.median(bounds);
    if (!(bound > 0)) return;
    const { alpha, lambda } = this.study.conditions.find((one) => one.name === condition);
    const points = alpha.map((one, i) => [one * bound, lambda[i] * Math.sqrt(bound)]);
    this.curved = [x.name.endsWith(".alpha") ? points : points.map(([a, b]) => [b, a])];
    this.bound = bound;
  }
  /** The side whose gains the axes are, if they are. */
  gains() {
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
  label() {
    return this.study.metric(this.view.metric).label;
  }
  axes(context, colour) {
    const { box, view } = this;
    context.fillStyle = context.strokeStyle = colour;
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
      const name = dim.unit ? `${dim.name} (${dim.unit})` : dim.name;
      context.save();
      context.textAlign = "center";
      if (i) { context.translate(14, box.top + box.height / 2); context.rotate(-Math.PI / 2); context.fillText(name, 0, 0); }
      else context.fillText(name, box.left + box.width / 2, box.top + box.height + 30);
      context.restore();
    });
  }
  bar(context, colours, colour) {
    const { box } = this, left = box.left + box.width + 16;
    for (let k = 0; k < box.height; k++) {
      context.fillStyle = `rgb(${colours[Math.round(255 * (1 - k / box.height))].join(",")})`;
      context.fillRect(left, box.top + k, 14, 1.5);
    }
    context.fillStyle = colour;
    context.textAlign = "left";
    context.textBaseline = "middle";
    for (let k = 0; k <= 4; k++) context.fillText(text(this.scaled.value(k / 4)), left + 18, box.top + box.height * (1 - k / 4));
  }
  /** The cell at a place in pixels: indices along both axes; null outside. */
  cell([px, py]) {
    const { box } = this, shares = [(px - box.left) / box.width, 1 - (py - box.top) / box.height];
    if (shares.some((one) => one < 0 || one >= 1)) return null;
    return shares.map((one, i) => this.view.from[i] + Math.floor(one * this.size()[i]));
  }
  value(cell) {
    const at = cell.map((one, i) => Math.floor((one - this.view.from[i]) / this.shown.step[i]));
    return this.shown.values[at[1] * this.shown.cells[0] + at[0]];
  }
  lines(cell) {
    const value = this.value(cell);
    const places = [this.view.x, this.view.y].map((dim, i) => `${dim.name}: ${text(dim.values[cell[i]])} ${dim.unit}`.trim());
    return [`${this.label()}: ${Number.isNaN(value) ? "none" : text(value)}`, ...places];
  }
  mark() {
    const context = this.over.getContext("2d"), { box } = this;
    context.clearRect(0, 0, this.width, this.height);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    for (const points of this.curved ?? []) {
      for (const [colour, width] of [["#000000", 4], ["#FFD400", 2]]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.beginPath();
        for (const [a, b] of points) context.lineTo(box.left + box.width * this.share(0, a), box.top + box.height * (1 - this.share(1, b)));
        context.stroke();
      }
    }
    context.restore();
    if (this.brush) {
      const [[ax, ay], [bx, by]] = this.brush;
      context.strokeStyle = "#ffffff";
      context.lineWidth = 3;
      context.strokeRect(Math.min(ax, bx), Math.min(ay, by), Math.abs(ax - bx), Math.abs(ay - by));
      context.strokeStyle = "#000000";
      context.lineWidth = 1;
      context.strokeRect(Math.min(ax, bx), Math.min(ay, by), Math.abs(ax - bx), Math.abs(ay - by));
    }
    if (this.cursor) {
      const size = this.size(), shares = this.cursor.map((one, i) => (one - this.view.from[i] + 0.5) / size[i]);
      const place = [box.left + box.width * shares[0], box.top + box.height * (1 - shares[1])];
      context.lineWidth = 3;
      for (const [colour, radius] of [["#000000", 7], ["#ffffff", 5]]) {
        context.strokeStyle = colour;
        context.beginPath();
        context.arc(...place, radius, 0, 2 * Math.PI);
        context.stroke();
      }
    }
  }
}

/** A line of values over an axis, through the chosen cell. */
const cut = (canvas, picture, i) => {
  const { study, view, cursor } = picture, dim = [view.x, view.y][i];
  const along = { ...view, from: [...cursor], to: cursor.map((one) => one + 1), most: [1e9, 1e9] };
  along.from[i] = 0;
  along.to[i] = dim.size;
  const { values } = mapped(study, picture.column, along);
  const width = Math.min(560, Math.floor($("plot").clientWidth * 0.49)), height = 260, density = devicePixelRatio || 1;
  Object.assign(canvas, { width: width * density, height: height * density });
  canvas.style.width = `${width}px`;
  const context = canvas.getContext("2d"), style = getComputedStyle(document.body);
  context.setTransform(density, 0, 0, density, 0, 0);
  const box = { left: 70, top: 12, width: width - 84, height: height - 60 };
  const finite = [...values].filter(Number.isFinite), log = picture.log && finite.every((one) => one > 0);
  const map = log ? Math.log : (one) => one;
  let [low, high] = [Math.min(...finite), Math.max(...finite)].map(map);
  if (!(low < high)) [low, high] = [low - 1, high + 1];
  const place = (k) => [box.left + (box.width * (k + 0.5)) / dim.size, box.top + box.height * (1 - (map(values[k]) - low) / (high - low))];
  context.strokeStyle = "#0072B2";
  context.lineWidth = 2;
  context.beginPath();
  values.forEach((value, k) => (Number.isFinite(value) && Number.isFinite(values[k - 1]) ? context.lineTo(...place(k)) : context.moveTo(...place(k))));
  context.stroke();
  if (Number.isFinite(values[cursor[i]])) {
    context.fillStyle = "#D55E00";
    context.beginPath();
    context.arc(...place(cursor[i]), 5, 0, 2 * Math.PI);
    context.fill();
  }
  context.fillStyle = style.color;
  context.font = "13px system-ui, sans-serif";
  context.textAlign = "right";
  for (let k = 0; k <= 4; k++) {
    const value = low + (k / 4) * (high - low);
    context.fillText(text(log ? Math.exp(value) : value), box.left - 8, box.top + box.height * (1 - k / 4) + 4);
  }
  context.textAlign = "center";
  for (let k = 0; k < dim.size; k += Math.max(1, Math.ceil(dim.size / 5))) context.fillText(text(dim.values[k]), place(k)[0], box.top + box.height + 18);
  context.fillText(dim.unit ? `${dim.name} (${dim.unit})` : dim.name, box.left + box.width / 2, box.top + box.height + 40);
  canvas.setAttribute("aria-label", `${picture.label()} over ${dim.name}, from ${text(Math.min(...finite))} to ${text(Math.max(...finite))}`);
};

/** The point of the chosen cell as a study that includes this one; the first value of what is averaged over. */
const pointText = (picture) => {
  const { study, view, cursor } = picture, lines = ['include = "study.toml"', "axes = []", "figures = []"];
  for (const dim of study.dims) {
    const i = dim === view.x ? cursor[0] : dim === view.y ? cursor[1] : view.at[dim.i] === "all" ? 0 : view.at[dim.i];
    for (const one of dim.paths) {
      if (one.path !== "seed") lines.push(`${one.path} = ${typeof one.values[i] === "string" ? JSON.stringify(one.values[i]) : exact(one.values[i])}`);
    }
  }
  return `${lines.join("\n")}\n`;
};
const exact = (value) => (Number.isInteger(value) ? value.toFixed(1) : String(value));

const save = (name, url) => made("a", { href: url, download: name }).click();

/* ------------------------------------------------------------------------------------------------------------ page */

globalThis.jaxblStudy = async (about) => {
  const study = new Study(about);
  document.title = $("title").textContent = about.title;
  $("lead").replaceChildren(...about.lead.map((line) => made("p", { textContent: line })));
  $("config").textContent = about.config;
  const picture = new Picture(study), { view } = picture, plot = $("plot");
  const choose = (label, id, options, chosen, act) => {
    const select = made("select", { id }, ...options.map(([value, name]) => made("option", { value, textContent: name, selected: String(value) === String(chosen) })));
    select.addEventListener("change", () => { act(select.value); form(); picture.update(); });
    return made("label", {}, label, select);
  };
  const form = () => {
    const dims = study.varied.filter((dim) => dim.paths[0].path !== "seed").map((dim) => [dim.i, dim.name]);
    const swap = (name, other) => (value) => {
      const dim = study.dims[value];
      if (dim === view[other]) view[other] = view[name];
      view[name] = dim;
      picture.cursor = null;
      $("cuts").hidden = true;
      picture.whole();
    };
    $("choice").replaceChildren(
      choose("metric", "metric", study.metrics.map((one) => [one.name, one.label]), view.metric, (value) => { view.metric = value; }),
      choose("x", "x", dims, view.x.i, swap("x", "y")),
      choose("y", "y", dims, view.y.i, swap("y", "x")),
      ...study.varied.filter((dim) => dim !== view.x && dim !== view.y).map((dim) =>
        choose(dim.name, `at${dim.i}`, [["all", "all"], ...dim.values.map((value, i) => [i, `${text(value)} ${dim.unit}`.trim()])], view.at[dim.i],
          (value) => { view.at[dim.i] = value === "all" ? value : Number(value); })),
      choose("of several", "how", Object.keys(reduced).map((one) => [one, one]), view.how, (value) => { view.how = value; }),
      ...(picture.gains() ? [choose("gain condition", "condition", [["none", "none"], ...study.conditions.map((one) => [one.name, one.title])], view.condition ?? "none",
        (value) => { view.condition = value; })] : []),
      choose("colours", "log", [["true", "logarithmic where it fits"], ["false", "linear"]], view.log, (value) => { view.log = value === "true"; }),
    );
  };
  form();
  const at = (event) => {
    const box = plot.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const show = (cell, place) => {
    const values = $("values");
    values.hidden = !cell;
    if (!cell) return;
    values.textContent = picture.lines(cell).join("\n");
    const right = place[0] + 16 + values.offsetWidth > plot.clientWidth;
    values.style.left = `${right ? place[0] - 16 - values.offsetWidth : place[0] + 16}px`;
    values.style.top = `${Math.min(place[1] + 16, plot.clientHeight - values.offsetHeight)}px`;
  };
  const take = (cell) => {
    picture.cursor = cell;
    picture.mark();
    $("point").disabled = false;
    $("cuts").hidden = false;
    $("where").textContent = picture.lines(cell).slice(1).join(", ");
    cut($("cutx"), picture, 0);
    cut($("cuty"), picture, 1);
    const averaged = study.varied.filter((dim) => dim !== view.x && dim !== view.y && dim.paths[0].path !== "seed" && view.at[dim.i] === "all");
    const first = averaged.length ? ` Of ${averaged.map((dim) => dim.name).join(", ")} it has the first value.` : "";
    $("command").textContent = `Save the point beside study.toml, and simulate it: jaxbl simulate point.toml.${first}`;
  };
  plot.addEventListener("pointerdown", (event) => { if (picture.column) { picture.brush = [at(event), at(event)]; plot.setPointerCapture(event.pointerId); } });
  plot.addEventListener("pointermove", (event) => {
    // the first picture has not all points
    if (!picture.column) return;
    if (picture.brush) { picture.brush[1] = at(event); picture.mark(); }
    show(picture.cell(at(event)), at(event));
  });
  plot.addEventListener("pointerup", () => {
    const { brush } = picture;
    picture.brush = null;
    if (!brush) return;
    const [a, b] = brush.map((place) => picture.cell(place));
    if (a && b && Math.hypot(brush[0][0] - brush[1][0], brush[0][1] - brush[1][1]) > 8) {
      view.from = [0, 1].map((i) => Math.min(a[i], b[i]));
      view.to = [0, 1].map((i) => Math.max(a[i], b[i]) + 1);
      picture.update();
    } else if (a) take(a);
    picture.mark();
  });
  plot.addEventListener("pointerleave", () => show(null));
  plot.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (step && picture.column) {
      const start = picture.cursor ?? [0, 1].map((i) => (view.from[i] + view.to[i]) >> 1);
      picture.cursor = start.map((one, i) => Math.min(view.to[i] - 1, Math.max(view.from[i], one + step[i])));
      picture.mark();
      $("state").textContent = picture.lines(picture.cursor).join("; ");
    } else if (event.key === "Enter" && picture.cursor) take(picture.cursor);
    else if (event.key === "0") { picture.whole(); picture.update(); }
    else return;
    event.preventDefault();
  });
  $("whole").addEventListener("click", () => { picture.whole(); picture.update(); });
  $("picture").addEventListener("click", () => save("map.png", picture.canvas.toDataURL("image/png")));
  $("point").addEventListener("click", () => save("point.toml", URL.createObjectURL(new Blob([pointText(picture)], { type: "application/toml" }))));
  addEventListener("resize", () => picture.update());
  picture.first();
  try {
    await picture.update();
  } catch (error) {
    $("state").textContent = `The study's points cannot be read: ${error.message}`;
  }
};
