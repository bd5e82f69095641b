"use strict";
/* What the explorer's pages share: elements, numbers as text, files read by parts, and lines over axes. */

const $ = (id) => document.getElementById(id);
const made = (tag, properties = {}, ...children) => {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
};
/** The same with as many digits as tell values between these ends apart. */
const textBetween = (value, [low, high]) =>
  Number.isFinite(value) && high - low < 0.05 * Math.abs(value) ? String(Number(value.toPrecision(9))) : text(value);
const withUnit = (name, unit) => (unit ? `${name} (${unit})` : name);
const save = (name, url) => made("a", { href: url, download: name }).click();
const saveText = (name, content) => save(name, URL.createObjectURL(new Blob([content], { type: "application/toml" })));
const choose = (label, id, options, chosen, act) => {
  const select = made("select", { id }, ...options.map(([value, name]) => made("option", { value, textContent: name, selected: String(value) === String(chosen) })));
  select.addEventListener("change", () => act(select.value));
  return made("label", {}, label, select);
};

/** Title, what was found, and the config. */
const head = ({ title, lead, config, file }) => {
  const lines = lead.map((line) => made("p", { textContent: line })), more = lines.splice(3);
  document.title = $("title").textContent = title;
  $("lead").replaceChildren(...lines, ...(more.length ? [made("details", {}, made("summary", { textContent: "more of what was found" }), ...more)] : []));
  $("config").textContent = config;
  $("configname").textContent = file;
};

/* ------------------------------------------------------------------------------------------------------------- data */

const waiting = new Map();
/** Called by the scripts that carry a Parquet file for pages opened from disk. */
globalThis.jaxblBytes = (number, content) => {
  waiting.get(number)(Uint8Array.from(atob(content), (one) => one.charCodeAt(0)));
};

/** The Parquet file beside the page as hyparquet reads it: its length, and bytes from and to. */
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

/** Columns of the Parquet file beside the page, each read when it is asked for. */
class Columns {
  /** `most` columns are kept; `told` hears the share that is read. */
  constructor(about, most, told) {
    Object.assign(this, { rows: about.rows, file: bytesOf(about), most, told, kept: new Map() });
  }
  get(name, Kind = Float32Array) {
    if (!this.kept.has(name)) {
      if (this.kept.size >= this.most) this.kept.delete(this.kept.keys().next().value);
      const read = this.read(name, Kind);
      // it may be there later
      read.catch(() => { this.kept.delete(name); this.metadata = null; });
      this.kept.set(name, read);
    }
    return this.kept.get(name);
  }
  async read(name, Kind) {
    this.metadata ??= hyparquet.parquetMetadataAsync(this.file);
    const metadata = await this.metadata, out = new Kind(this.rows);
    let rowStart = 0;
    for (const group of metadata.row_groups) {
      const rowEnd = rowStart + Number(group.num_rows);
      // the page stays alive
      await new Promise((resolve) => setTimeout(resolve));
      this.told(name, rowStart / this.rows);
      await hyparquet.parquetRead({
        file: this.file, metadata, columns: [name], rowStart, rowEnd,
        onChunk: ({ columnData, rowStart: first }) => out.set(columnData, first),
      });
      rowStart = rowEnd;
    }
    return out;
  }
}

/** What reads and draws, as a function that says it where that fails. */
const reporting = (what, act) => () => act().catch((error) => { $("state").textContent = `${what} cannot be read: ${error.message}`; });

/* ------------------------------------------------------------------------------------------------------------ plots */

/** Okabe and Ito's colours, which colour-blind readers can tell apart. */
const COLOURS = ["#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];

/** Round values between two ends, about so many. */
const ticks = (low, high, count) => {
  const rough = (high - low) / count, size = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((one) => one * size).find((one) => one >= rough), first = Math.ceil(low / step);
  const out = [];
  // where an axis is enlarged beyond what numbers tell apart, there is no next one
  for (let k = 0; k <= count && (first + k) * step <= high + 1e-9 * step; k++) out.push(Number(((first + k) * step).toPrecision(12)));
  return out;
};

/** The same on a logarithmic axis. */
const logTicks = (low, high, count) => {
  const decades = Math.log10(high / low);
  if (decades < 1) return ticks(low, high, count).filter((one) => one > 0);
  const out = [], factors = decades > count / 2 ? [1] : decades > count / 4 ? [1, 3] : [1, 2, 5], every = Math.ceil(decades / count);
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k += every) {
    out.push(...factors.map((one) => Number(`${one}e${k}`)).filter((one) => one >= low && one <= high));
  }
  return out;
};

/** Colours of values from low to high: { colours, low, high, log, label, unit, names }, colours as [red, green, blue]; names as of
 * an axis. */
class Scale {
  constructor(of) { Object.assign(this, of); }
  /** Of finite values; logarithmic where they are positive and span more than a factor of 30. */
  static of(values, about) {
    let [low, high] = [Infinity, -Infinity];
    for (const one of values) if (Number.isFinite(one)) { low = Math.min(low, one); high = Math.max(high, one); }
    // of no values, or of one value
    const one = low > high ? "no value" : low === high ? text(low) : "";
    if (low > high) [low, high] = [0, 1];
    if (low === high) [low, high] = [low - 0.5 * Math.abs(low) - 1e-12, high + 0.5 * Math.abs(high) + 1e-12];
    return new Scale({ one, low, high, log: low > 0 && high / low > 30, ...about });
  }
  share(value) { return this.log ? Math.log(value / this.low) / Math.log(this.high / this.low) : (value - this.low) / (this.high - this.low); }
  value(share) { return this.log ? this.low * (this.high / this.low) ** share : this.low + share * (this.high - this.low); }
  colour(value) { return Number.isFinite(value) ? this.colours[Math.round(255 * Math.min(1, Math.max(0, this.share(value))))] : MISSING; }
  /** What it says. */
  get said() { return this.one || `from ${text(this.low)} to ${text(this.high)}`; }
  /** A bar with values beside it. */
  draw(context, colour, left, top, height) {
    for (let k = 0; k < height; k++) {
      context.fillStyle = `rgb(${this.colours[Math.round(255 * (1 - k / height))].join(",")})`;
      context.fillRect(left, top + k, 14, 1.5);
    }
    Object.assign(context, { fillStyle: colour, font: "13px system-ui, sans-serif", textAlign: "left", textBaseline: "middle" });
    const shares = this.one ? [[this.one, 0.5]] : [0, 1, 2, 3, 4].map((k) => [text(this.value(k / 4)), k / 4]);
    const marks = this.names ? this.names.map((name, k) => [name, this.share(k)]) : shares;
    for (const [name, share] of marks) if (share >= 0 && share <= 1) context.fillText(name, left + 18, top + height * (1 - share), 76);
  }
}
const coloursOf = (about) => about.colours.map((one) => [1, 3, 5].map((i) => parseInt(one.slice(i, i + 2), 16)));
/** The colour of no value. */
const MISSING = [189, 189, 189];

/** A canvas of one pixel a cell, [red, green, blue, opacity] by the cell's number, rows upwards; null leaves it empty. */
const sheetOf = ([width, height], pixel) => {
  const sheet = Object.assign(document.createElement("canvas"), { width, height }), image = new ImageData(width, height);
  for (let j = 0; j < height; j++) {
    for (let i = 0; i < width; i++) {
      const colour = pixel(j * width + i);
      if (colour) image.data.set(colour, 4 * ((height - 1 - j) * width + i));
    }
  }
  sheet.getContext("2d").putImageData(image, 0, 0);
  return sheet;
};
/** Puts a box of values beside a place in a view, inside of it. */
const beside = (values, [x, y], view) => {
  const right = x + 14 + values.offsetWidth > view.clientWidth;
  values.style.left = `${Math.max(0, right ? x - 14 - values.offsetWidth : x + 14)}px`;
  values.style.top = `${Math.max(0, Math.min(y + 14, view.clientHeight - values.offsetHeight))}px`;
};

/**
 * Lines over axes in a canvas: values under the pointer and by arrow keys, drag to enlarge, double click or 0 for the whole.
 *
 * `x` and `y` are { label, unit, names, log, limits }: names stand for the numbers 0, 1, ...; limits leave out what lies beyond.
 * Cells, behind the lines, are { x, y, size, values }: ends along both axes, numbers of cells, values in rows of y. `scale` gives their
 * colours, and those of dots with `shade`, a value each. `cursor`, [x, y] or null, is marked by a ring.
 * `picked` hears which sample is clicked.
 * A line is { name, x, y, colour, alpha, dash, width, dots, sorted, marks, said }; `named` says the lines' names above.
 */
class Plot {
  constructor(element, { x, y, height = 240, caption = "", zoomed = null, picked = null, named = false }) {
    Object.assign(this, { element, x, y, height, lines: [], range: null, bands: [], zoomed, picked, named, cells: null, scale: null, cursor: null });
    this.canvas = made("canvas");
    this.canvas.setAttribute("role", "img");
    this.values = made("div", { className: "values", hidden: true });
    this.values.setAttribute("aria-live", "polite");
    this.view = made("div", { className: "plane", tabIndex: 0 }, this.canvas, this.values);
    this.view.setAttribute("role", "application");
    this.key = made("div");
    element.replaceChildren(this.key, this.view, made("figcaption", { textContent: caption }));
    this.listen();
  }
  get box() { return { left: 82, top: 10, width: Math.max(this.width - (this.scale ? 176 : 96), 10), height: this.height - 58 }; }
  /** Lines, and { from, to, name } along x that are shaded. */
  set(lines, bands = []) {
    this.lines = lines.filter((one) => one.x.length);
    this.bands = bands;
    this.key.replaceChildren(...(this.named ? [legend([...this.lines.map((one) => [one.name, one.colour ?? "currentColor", one.dash?.length]), ...bands.slice(0, 1).map((one) => [one.name, "#8a8d93"])])] : []));
    this.draw();
  }
  /** Ends of both axes of what is shown. */
  ends() {
    const whole = [this.x, this.y].map((axis, i) => {
      let [low, high] = [Infinity, -Infinity];
      for (const line of this.lines) {
        for (const value of i ? line.y : line.x) {
          if (Number.isFinite(value) && (!axis.log || value > 0)) { low = Math.min(low, value); high = Math.max(high, value); }
        }
      }
      if (axis.limits) [low, high] = axis.limits;
      if (!(low <= high)) [low, high] = axis.log ? [1, 10] : [0, 1];
      if (low === high) { const more = Math.abs(low) || 1; [low, high] = axis.log ? [low / 2, 2 * high] : [low - 0.5 * more, high + 0.5 * more]; }
      const dots = this.lines.some((one) => one.dots), room = axis.limits ? 0 : axis.names ? 0.5 : i || dots ? 0.04 * (axis.log ? Math.log(high / low) : high - low) : 0;
      return axis.log ? [low * Math.exp(-room), high * Math.exp(room)] : [low - room, high + room];
    });
    return whole.map((one, i) => this.range?.[i] ?? one);
  }
  scales() {
    const ends = this.ends(), { box } = this;
    return [this.x, this.y].map((axis, i) => {
      const map = axis.log ? Math.log : (one) => one, [low, high] = ends[i].map(map);
      const [start, length] = i ? [box.top + box.height, -box.height] : [box.left, box.width];
      const back = (place) => low + ((place - start) / length) * (high - low);
      return { ends: ends[i], place: (value) => start + (length * (map(value) - low)) / (high - low), value: (place) => (axis.log ? Math.exp(back(place)) : back(place)) };
    });
  }
  draw() {
    const { canvas } = this, density = devicePixelRatio || 1, style = getComputedStyle(document.body);
    this.width = this.view.clientWidth;
    Object.assign(canvas, { width: this.width * density, height: this.height * density });
    canvas.style.height = `${this.height}px`;
    const context = canvas.getContext("2d"), { box } = this, [x, y] = (this.scaled = this.scales());
    context.setTransform(density, 0, 0, density, 0, 0);
    context.fillStyle = style.backgroundColor;
    context.fillRect(0, 0, this.width, this.height);
    if (this.cells) this.image(context, x, y);
    this.scale?.draw(context, style.color, box.left + box.width + 14, box.top, box.height);
    this.axes(context, style);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    for (const { from, to } of this.bands) {
      context.fillStyle = "#8a8d9340";
      context.fillRect(x.place(from), box.top, x.place(to) - x.place(from), box.height);
    }
    for (const line of this.lines) this.line(context, line, x, y, style.color);
    if (this.cursor) {
      for (const [colour, width] of [["#ffffff", 5], ["#000000", 2]]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.beginPath();
        context.arc(x.place(this.cursor[0]), y.place(this.cursor[1]), 6, 0, 2 * Math.PI);
        context.stroke();
      }
    }
    context.restore();
    const { scale } = this, names = this.lines.map((one) => one.name).filter(Boolean).join(", ");
    const told = scale ? `colours: ${withUnit(scale.label, scale.unit)}, ${scale.said}` : names;
    canvas.setAttribute("aria-label", `${withUnit(this.y.label, this.y.unit)} over ${withUnit(this.x.label, this.x.unit)}, from ${text(y.ends[0])} to ${text(y.ends[1])}: ${told}`);
    this.view.setAttribute("aria-label", `${this.y.label} over ${this.x.label}: arrow keys read values, 0 shows the whole`);
  }
  image(context, x, y) {
    const { size, values } = this.cells;
    const sheet = sheetOf(size, (k) => (Number.isFinite(values[k]) ? [...this.scale.colour(values[k]), 255] : null));
    context.imageSmoothingEnabled = false;
    const { box } = this, [left, right] = this.cells.x.map(x.place), [bottom, top] = this.cells.y.map(y.place);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    // where there is none, which is no zero
    context.fillStyle = "#8a8d9340";
    context.fillRect(box.left, box.top, box.width, box.height);
    context.drawImage(sheet, left, top, right - left, bottom - top);
    context.restore();
  }
  line(context, line, x, y, colour) {
    context.strokeStyle = context.fillStyle = line.colour ?? colour;
    context.globalAlpha = line.alpha ?? 1;
    context.lineWidth = line.width ?? 1.5;
    context.setLineDash(line.dash ?? []);
    if (line.dots) {
      const size = line.dots;
      for (let i = 0; i < line.x.length; i++) {
        if (line.shade) context.fillStyle = `rgb(${this.scale.colour(line.shade[i]).join(",")})`;
        context.fillRect(x.place(line.x[i]) - size / 2, y.place(line.y[i]) - size / 2, size, size);
      }
      context.globalAlpha = 1;
      return;
    }
    context.beginPath();
    const first = line.sorted ? before(line.x, x.ends[0]) : 0;
    const last = line.sorted ? Math.min(before(line.x, x.ends[1]) + 2, line.x.length) : line.x.length;
    if (line.sorted && last - first > 4 * this.width) {
      // more samples than pixels: the least and largest of each column
      let column = NaN, low = 0, high = 0;
      for (let i = first; i < last; i++) {
        const at = Math.round(x.place(line.x[i])), value = y.place(line.y[i]);
        if (!Number.isFinite(value)) continue;
        if (at === column) { low = Math.min(low, value); high = Math.max(high, value); continue; }
        if (column === column) { context.lineTo(column, low); context.lineTo(column, high); }
        [column, low, high] = [at, value, value];
      }
      context.lineTo(column, low);
      context.lineTo(column, high);
    } else {
      let apart = true;
      for (let i = first; i < last; i++) {
        const at = y.place(line.y[i]);
        if (!Number.isFinite(at)) { apart = true; continue; }
        if (apart) context.moveTo(x.place(line.x[i]), at); else context.lineTo(x.place(line.x[i]), at);
        apart = false;
      }
    }
    context.stroke();
    context.globalAlpha = 1;
    context.setLineDash([]);
    for (const i of line.marks ?? []) {
      context.beginPath();
      context.arc(x.place(line.x[i]), y.place(line.y[i]), 5, 0, 2 * Math.PI);
      context.fill();
    }
  }
  axes(context, style) {
    const { box } = this;
    context.font = "13px system-ui, sans-serif";
    [this.x, this.y].forEach((axis, i) => {
      const { ends, place } = this.scaled[i], count = Math.max(2, Math.floor(i ? box.height / 45 : box.width / 95));
      let at = (axis.log ? logTicks : ticks)(...ends, count);
      if (axis.names) {
        const [low, high] = [Math.max(0, Math.ceil(ends[0])), Math.min(axis.names.length - 1, Math.floor(ends[1]))];
        const every = Math.max(1, Math.ceil((high - low + 1) / count));
        at = [];
        for (let k = low; k <= high; k += every) at.push(k);
      }
      for (const value of at) {
        const along = place(value), name = axis.names ? axis.names[value] : textBetween(value, ends);
        context.strokeStyle = style.color;
        context.globalAlpha = 0.15;
        context.lineWidth = 1;
        context.beginPath();
        if (i) { context.moveTo(box.left, along); context.lineTo(box.left + box.width, along); }
        else { context.moveTo(along, box.top); context.lineTo(along, box.top + box.height); }
        context.stroke();
        context.globalAlpha = 1;
        context.fillStyle = style.color;
        context.textAlign = i ? "right" : "center";
        context.textBaseline = i ? "middle" : "top";
        if (i) context.fillText(name, box.left - 7, along); else context.fillText(name, along, box.top + box.height + 7);
      }
      context.save();
      context.fillStyle = style.color;
      context.textAlign = "center";
      const name = withUnit(axis.label, axis.unit), most = i ? box.height + 40 : box.width;
      if (i) { context.translate(12, box.top + box.height / 2); context.rotate(-Math.PI / 2); context.fillText(name, 0, 0, most); }
      else context.fillText(name, box.left + box.width / 2, box.top + box.height + 26, most);
      context.restore();
    });
  }
  /** The sample nearest to a place in pixels: the line, its index; none is farther than 40 pixels. */
  nearest([px, py]) {
    const [x, y] = this.scaled;
    if (this.cells) return this.cell([x.value(px), y.value(py)]);
    let best = null, least = 40 * 40;
    for (const line of this.lines) {
      let first = 0, last = line.x.length;
      if (line.sorted) { first = before(line.x, x.value(px - 40)); last = Math.min(before(line.x, x.value(px + 40)) + 2, last); }
      for (let i = first; i < last; i++) {
        const distance = (x.place(line.x[i]) - px) ** 2 + (y.place(line.y[i]) - py) ** 2;
        if (distance < least) [best, least] = [{ line, i }, distance];
      }
    }
    return best;
  }
  /** The cell at a point: its middle and its value; null where there is none. */
  cell(point) {
    const { size, values } = this.cells, ends = [this.cells.x, this.cells.y];
    const at = point.map((one, i) => Math.floor((size[i] * (one - ends[i][0])) / (ends[i][1] - ends[i][0])));
    if (at.some((one, i) => !(one >= 0 && one < size[i]))) return null;
    const value = values[at[1] * size[0] + at[0]];
    return Number.isFinite(value) ? { value, cell: at.map((one, i) => ends[i][0] + ((one + 0.5) * (ends[i][1] - ends[i][0])) / size[i]) } : null;
  }
  show(found) {
    const [x, y] = this.scaled ?? [];
    this.values.hidden = !found;
    if (!found) return;
    const { line, i, cell } = found, say = (axis, value, ends) => `${axis.label}: ${axis.names ? axis.names[Math.round(value)] : textBetween(value, ends)} ${axis.unit ?? ""}`.trim();
    const place = cell ?? [line.x[i], line.y[i]], name = cell ? say(this.scale, found.value, [-Infinity, Infinity]) : line.name;
    this.values.textContent = [name, ...(line?.said?.(i) ?? []), say(this.x, place[0], x.ends), say(this.y, place[1], y.ends)].filter(Boolean).join("\n");
    beside(this.values, [x.place(place[0]), y.place(place[1])], this.view);
  }
  zoom(range) {
    this.range = range;
    this.draw();
    this.show(null);
    this.zoomed?.(range);
  }
  listen() {
    const { view } = this;
    const at = (event) => {
      const box = view.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    let from = null, chosen = null;
    view.addEventListener("pointerdown", (event) => { from = at(event); view.setPointerCapture(event.pointerId); });
    view.addEventListener("pointermove", (event) => {
      if (!this.scaled) return;
      if (!from) return this.show(this.nearest(at(event)));
      this.draw();
      const context = this.canvas.getContext("2d"), to = at(event);
      context.strokeStyle = getComputedStyle(document.body).color;
      context.strokeRect(Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]));
    });
    view.addEventListener("pointerup", (event) => {
      const start = from, to = at(event);
      from = null;
      if (!start || Math.abs(to[0] - start[0]) < 8) {
        this.draw();
        const found = start && this.nearest(to);
        if (found) this.picked?.(found);
        return;
      }
      const range = this.scaled.map(({ value }, i) => [value(start[i]), value(to[i])].sort((a, b) => a - b));
      // a drag along x alone keeps the other axis
      this.zoom([range[0], Math.abs(to[1] - start[1]) < 8 ? null : range[1]]);
    });
    view.addEventListener("dblclick", () => this.zoom(null));
    view.addEventListener("pointerleave", () => this.show(null));
    view.addEventListener("blur", () => { chosen = null; this.show(null); });
    view.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], turn = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      if (!this.lines.length) return;
      if (event.key === "0" || event.key === "Escape") this.zoom(null);
      else if (step || turn) {
        const count = this.lines.length;
        const line = chosen ? (chosen.line + (turn ?? 0) + count) % count : 0, length = this.lines[line].x.length;
        const i = (chosen?.i ?? 0) + (chosen ? step ?? 0 : 0) * Math.max(1, Math.floor(length / 100));
        chosen = { line, i: Math.min(length - 1, Math.max(0, i)) };
        this.show({ line: this.lines[line], i: chosen.i });
      } else if (event.key === "Enter" && chosen && this.picked) this.picked({ line: this.lines[chosen.line], i: chosen.i });
      else return;
      event.preventDefault();
    });
  }
}

/** Names and colours of lines. */
const legend = (entries) => made("p", { className: "legend" }, ...entries.map(([name, colour, dashed]) => {
  const mark = made("span", { className: dashed ? "mark dashed" : "mark" });
  mark.style.borderTopColor = colour;
  return made("span", {}, mark, name);
}));
