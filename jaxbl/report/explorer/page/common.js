"use strict";
/* What the explorer's pages share: what is chosen, the address, files read by parts, colours, and what is saved. */

const $ = (id) => document.getElementById(id);
const save = (name, url) => made("a", { href: url, download: name }).click();
const saveText = (name, content, type = "application/toml") => save(name, URL.createObjectURL(new Blob([content], { type })));
/** Columns of numbers and words, by name, as a table for other programs. */
const saveTable = (name, columns) => {
  const names = Object.keys(columns), quoted = (one) => (/[",\n]/.test(one) ? `"${String(one).replaceAll('"', '""')}"` : String(one));
  saveText(name, [names, ...Array.from(columns[names[0]], (_, i) => names.map((one) => columns[one][i]))].map((row) => row.map(quoted).join(",")).join("\n") + "\n", "text/csv");
};
/** An element as it is seen, its canvases and its texts, as PNG. */
const savePicture = (name, element) => {
  // what stands below the last canvas is no part of it
  const whole = element.getBoundingClientRect(), bottom = Math.max(...Array.from(element.querySelectorAll("canvas"), (one) => one.getBoundingClientRect().bottom));
  const sheet = made("canvas", { width: whole.width * devicePixelRatio, height: (bottom - whole.top + 4) * devicePixelRatio });
  const context = sheet.getContext("2d"), style = getComputedStyle(document.body);
  context.scale(devicePixelRatio, devicePixelRatio);
  context.fillStyle = style.backgroundColor;
  context.fillRect(0, 0, whole.width, whole.height);
  for (const one of element.querySelectorAll("canvas, .over, .legend > span, .mark")) {
    const { left, top, width, height } = one.getBoundingClientRect(), own = getComputedStyle(one), at = [left - whole.left, top - whole.top];
    if (one.matches("canvas")) context.drawImage(one, ...at, width, height);
    else if (one.matches(".mark")) { context.fillStyle = own.borderTopColor; context.fillRect(...at, width, 3); }
    else { Object.assign(context, { fillStyle: own.color, font: `${own.fontSize} system-ui, sans-serif`, textBaseline: "top" }); context.fillText(one.textContent, at[0] + (one.querySelector(".mark") ? 32 : 0), at[1] + 3, width); }
  }
  save(name, sheet.toDataURL("image/png"));
};
const addFigure = (parent) => parent.appendChild(made("figure"));
const choose = (label, id, options, chosen, act) => made("label", {}, label, made("select", { id, onchange: ({ target }) => act(target.value) },
  ...options.map(([value, name]) => made("option", { value, textContent: name, selected: String(value) === String(chosen) }))));
const tableOf = (element, heads, rows) => element.replaceChildren(
  made("thead", {}, made("tr", {}, ...heads.map((textContent) => made("th", { textContent, scope: "col" })))),
  made("tbody", {}, ...rows.map(([first, ...others]) => made("tr", {}, first instanceof Node ? made("td", {}, first) : made("th", { textContent: first, scope: "row" }), ...others.map((textContent) => made("td", { className: "number", textContent }))))),
);

/** What a link says of the view, as words by name. */
const address = {
  read: () => Object.fromEntries(new URLSearchParams(location.hash.slice(1))),
  write: (view) => history.replaceState(null, "", `#${new URLSearchParams(Object.entries(view).filter(([, value]) => value !== "" && value != null))}`),
};
addEventListener("hashchange", () => location.reload());

/** Title, what was found, and the config. */
const showHead = ({ title, lead, config, file }) => {
  const lines = lead.map((line) => made("p", { textContent: line })), more = lines.splice(1);
  document.title = $("title").textContent = title;
  $("lead").replaceChildren(...lines, ...(more.length ? [made("details", {}, made("summary", { textContent: "more of what was found" }), ...more)] : []));
  $("config").textContent = config;
  $("configname").textContent = file;
};

/** Parts of a Parquet file beside a page opened from disk: each is in a script, which calls this. */
const parts = new Map();
globalThis.jaxblBytes = (number, content) => { parts.get(number).resolve(bytesIn(content)); };
const loadPart = (number) => {
  if (!parts.has(number)) {
    const part = Promise.withResolvers(), src = `points.${String(number).padStart(4, "0")}.js`;
    parts.set(number, part);
    document.head.append(made("script", { src, onerror: () => part.reject(new Error(`${src} is missing`)) }));
  }
  return parts.get(number).promise;
};

/** The Parquet file beside the page as hyparquet reads it; of a page opened from disk, by scripts with a part each. */
const bytesOf = async ({ bytes: byteLength, script: size }) => {
  if (location.protocol !== "file:") return hyparquet.asyncBufferFromUrl({ url: "points.parquet", byteLength });
  const slice = async (start, end = byteLength) => {
    const first = Math.floor(start / size), out = new Uint8Array(end - start);
    const read = await Promise.all(Array.from({ length: Math.ceil(end / size) - first }, (_, k) => loadPart(first + k)));
    read.forEach((part, k) => out.set(part.subarray(Math.max(start - (first + k) * size, 0), end - (first + k) * size), Math.max((first + k) * size - start, 0)));
    return out.buffer;
  };
  return { byteLength, slice };
};

/** Columns of the Parquet file beside the page, each read when it is asked for. */
class Columns {
  /** `most` columns are kept. */
  constructor(about, most) { Object.assign(this, { rows: about.rows, file: bytesOf(about), most, kept: new Map() }); }
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
    const file = await this.file, metadata = await (this.metadata ??= hyparquet.parquetMetadataAsync(file)), out = new Kind(this.rows);
    let rowStart = 0;
    for (const group of metadata.row_groups) {
      const rowEnd = rowStart + Number(group.num_rows);
      // the page stays alive
      await new Promise((resolve) => setTimeout(resolve));
      $("state").textContent = `reading ${name}: ${Math.floor((100 * rowStart) / this.rows)} %`;
      await hyparquet.parquetRead({ file, metadata, columns: [name], rowStart, rowEnd, onChunk: (chunk) => out.set(chunk.columnData, chunk.rowStart) });
      rowStart = rowEnd;
    }
    return out;
  }
}

/** What reads and draws, as a function that says it where that fails. */
const reporting = (what, act) => () => act().catch((error) => { $("state").textContent = `${what} cannot be read: ${error.message}`; });

/** The colour of no value. */
const MISSING = [189, 189, 189];
const coloursOf = (about) => about.colours.map((one) => [1, 3, 5].map((i) => parseInt(one.slice(i, i + 2), 16)));

/** Colours of values from low to high: { colours, low, high, log, label, unit, names }, colours as [red, green, blue]; names as of
 * an axis. */
class Scale {
  constructor(given) { Object.assign(this, given, { share: along({ ends: [given.low, given.high], log: given.log }).share }); }
  /** Of finite values; logarithmic where they are positive and span more than a factor of 30. Of many, a hundredth at either end
   * lies beyond the colours. */
  static of(values, about) {
    const whole = endsOf([values]);
    // of no values, or of one value
    const one = whole[0] > whole[1] ? "no value" : whole[0] === whole[1] ? text(whole[0]) : "";
    let [low, high] = one === "no value" ? [0, 1] : whole;
    if (values.length > 400 && !one) {
      const every = Math.ceil(values.length / 20000), some = values.filter((value, i) => i % every === 0 && Number.isFinite(value)).sort((a, b) => a - b);
      [low, high] = [0.01, 0.99].map((share) => some[Math.round(share * (some.length - 1))]);
    }
    if (low === high) [low, high] = [low - 0.5 * Math.abs(low) - 1e-12, high + 0.5 * Math.abs(high) + 1e-12];
    return new Scale({ one, whole, low, high, log: low > 0 && high / low > 30, ...about });
  }
  colour(value) { return Number.isFinite(value) ? this.colours[Math.round(255 * clamped(this.share(value) || 0, 0, 1))] : MISSING; }
  /** What it says. */
  get said() { return this.one || `from ${text(this.whole[0])} to ${text(this.whole[1])}`; }
  /** A bar with round values below it, and with what it shows above. */
  draw(element) {
    const { low, high, log, one, label, unit } = this, names = one ? new Map([[(low + high) / 2, one]]) : this.names;
    const cells = { x: [low, high], y: [0, 1], size: [256, 1], colours: sheetOf([256, 1], (k) => [...this.colours[k], 255]), text: () => null };
    new Chart(element, { x: { ends: [low, high], log, names }, y: { ends: [0, 1], hidden: true }, cells, height: 48, title: withUnit(label, unit) });
    element.inert = true;
  }
}

/** A canvas of one pixel a cell, [red, green, blue, opacity] by the cell's number, rows upwards; null leaves it empty. */
const sheetOf = ([width, height], pixel) => {
  const sheet = made("canvas", { width, height }), image = new ImageData(width, height);
  for (let k = 0; k < width * height; k++) {
    const colour = pixel(k);
    if (colour) image.data.set(colour, 4 * ((height - 1 - Math.floor(k / width)) * width + (k % width)));
  }
  sheet.getContext("2d").putImageData(image, 0, 0);
  return sheet;
};
