"use strict";
/* The points of a study: its axes and metrics by name, a filter, and what is saved of a point. */

/** A study: `fields` by name, of axes and metrics: { name, label, unit, names, log, metric, read }; `read` gives a function of the
 * row. Over a grid there are `dims`, its axes as dimensions of an array; those that advance together are one. */
class Study {
  constructor(about) {
    Object.assign(this, about);
    // of very many rows few columns fit into memory
    this.columns = new Columns(about, about.rows > 2e6 ? 8 : 40, (name, share) => { $("state").textContent = `reading ${name}: ${Math.floor(100 * share)} %`; });
    this.colours = coloursOf(about);
    this.fields = new Map();
    this.dims = about.grid ? about.axes.map((axis, i) => dimension(axis, i)) : [];
    let stride = 1;
    for (const dim of [...this.dims].reverse()) { dim.stride = stride; stride *= dim.size; }
    const stored = (name, Kind) => async () => { const column = await this.columns.get(name, Kind); return (row) => column[row]; };
    for (const dim of this.dims) {
      for (const { path, label, unit, values } of dim.paths) {
        const names = values.every(Number.isFinite) ? null : values, at = (row) => Math.floor(row / dim.stride) % dim.size;
        this.fields.set(path, { name: path, label, unit, names, log: dim.log, varied: dim.size > 1, read: async () => (names ? at : (row) => values[at(row)]) });
      }
    }
    for (const { path, label, unit, words, log } of about.grid ? [] : [...about.axes, { path: "seed", label: "seed", unit: "" }]) {
      this.fields.set(path, { name: path, label, unit, names: words, log, varied: true, read: stored(path, Float64Array) });
    }
    for (const metric of about.metrics) this.fields.set(metric.name, { ...metric, unit: "", metric: true, read: stored(metric.name, Float32Array) });
    this.axes = [...this.fields.values()].filter((one) => !one.metric);
    this.named = this.axes.filter((one) => one.varied && one.name !== "seed").map((one) => one.name);
  }
  metric(name) { return this.metrics.find((one) => one.name === name); }
  column(name) { return this.columns.get(name); }
  /** Values of a row by path, and its seed; words as words. */
  async point(row) {
    const read = await Promise.all(this.axes.map((one) => one.read()));
    const { seed, ...values } = Object.fromEntries(this.axes.map(({ name, names }, i) => [name, names?.[read[i](row)] ?? read[i](row)]));
    return { values, seed };
  }
  /** A point in words. */
  said(values) { return this.axes.filter((one) => this.named.includes(one.name)).map(({ name, unit }) => `${name.replace(/^observer\./, "")} ${text(values[name])} ${unit}`.trim()).join(", "); }
  /** The field of a name, which may be its end: `alpha`, or `converged` of the side that is drawn; `margin` is that of the exact condition. */
  field(name, side) {
    const found = [...this.fields.keys()].filter((one) => one === name || one.endsWith(`.${name}`) || one.endsWith(`.${name}_exact`));
    const key = [name, `${side}.${name}`, `observer.${side}.${name}`, `${side}.${name}_exact`].find((one) => found.includes(one)) ?? found[0];
    if (!key) throw new Error(`Filter: '${name}' is no axis or metric; such as ${[...this.fields.keys()].slice(-3).join(", ")}.`);
    return this.fields.get(key);
  }
  /** Which rows pass a filter, such as `converged and margin > 1.1`: 1 or 0 each; null without one. */
  async mask(words, side) {
    if (!words.trim()) return null;
    const terms = words.trim().split(/\s+or\s+/).map((all) => all.split(/\s+and\s+/).map((term) => {
      const found = /^(not\s+)?([\w.]+)\s*(?:(<=|>=|!=|==?|<|>)\s*(\S+))?$/.exec(term.trim());
      if (!found) throw new Error(`Filter: '${term}' should be a name, or a name, one of < <= > >= = !=, and a number.`);
      const [, not, name, sign = "!=", given = "0"] = found, field = this.field(name, side);
      const number = field.names ? field.names.map(String).indexOf(given) : { yes: 1, no: 0 }[given] ?? Number(given);
      if (Number.isNaN(number) || (field.names && number < 0)) throw new Error(`Filter: ${given} should be ${field.names ? `one of ${field.names.join(", ")}` : "a number"}.`);
      const passes = { "<": (a) => a < number, "<=": (a) => a <= number, ">": (a) => a > number, ">=": (a) => a >= number, "!=": (a) => a !== number && a === a, "=": (a) => a === number, "==": (a) => a === number }[sign];
      return { field, passes: not ? (a) => a === a && !passes(a) : passes };
    }));
    const out = new Uint8Array(this.rows);
    for (const all of terms) {
      const read = await Promise.all(all.map(({ field }) => field.read())), { length } = all;
      for (let row = 0; row < this.rows; row++) {
        let passed = 1;
        for (let k = 0; passed && k < length; k++) passed = all[k].passes(read[k](row)) ? 1 : 0;
        out[row] |= passed;
      }
    }
    return out;
  }
}

/** A dimension of a grid: along evenly spaced values it is drawn as they are, else as their numbers. */
const dimension = ({ paths }, i) => {
  const { path, label, unit, values } = paths[0], size = values.length, numbers = values.every(Number.isFinite);
  const even = (map) => values.every((one, k) => k === 0 || (one > values[k - 1] && Math.abs(map(one) - map(values[k - 1]) - (map(values[size - 1]) - map(values[0])) / (size - 1)) < 1e-3 * Math.abs(map(values[1]) - map(values[0]))));
  const positive = numbers && values[0] > 0, log = positive && size > 2 && even(Math.log) && values[size - 1] / values[0] > 3, linear = !log && numbers && size > 1 && even((one) => one);
  const spaced = log || linear, map = log ? Math.log : (one) => one, back = log ? Math.exp : (one) => one, first = spaced ? map(values[0]) : 0, step = spaced ? map(values[1]) - first : 1;
  // between values that are not even, in their own scale
  const own = positive && values[size - 1] / values[0] > 20 ? Math.log : (one) => one, rising = numbers && values.every((one, k) => !k || one > values[k - 1]);
  const between = (value) => {
    const k = Math.max(1, values.findIndex((one) => one >= value) < 0 ? size - 1 : values.findIndex((one) => one >= value));
    return k - 1 + (own(value) - own(values[k - 1])) / (own(values[k]) - own(values[k - 1]));
  };
  return {
    i, size, paths, name: paths.map((one) => one.path).join(", "), path, values, seed: path === "seed", log, rising,
    axis: { label: paths.length > 1 ? `${label}, with ${paths.slice(1).map((one) => one.path).join(", ")}` : label, key: path, log, names: spaced ? null : values.map(text) },
    /** Where a place along the axis is drawn, and which one is drawn there; where a value is. */
    edge: (k) => back(first + step * k), index: (at) => Math.min(size - 1, Math.max(0, Math.round((map(at) - first) / step))),
    place: (value) => (spaced ? value : between(value)),
    said: (k) => paths.map((one) => `${text(one.values[k])} ${one.unit}`.trim()).join(", "),
  };
};

/** One number of several, nan left out. */
const reduced = {
  median: (values) => {
    const middle = values.sort().length >> 1;
    return values.length % 2 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
  },
  mean: (values) => (values.length ? values.reduce((a, b) => a + b, 0) / values.length : NaN),
  least: (values) => (values.length ? values.reduce((a, b) => Math.min(a, b)) : NaN),
  largest: (values) => (values.length ? values.reduce((a, b) => Math.max(a, b)) : NaN),
};

/** The map of a view, { x, y, from, to, most, at, how }: values (rows of y) of cells, each of one or more points along x and y; `out`
 * is 1 where the mask leaves none. */
const mapped = (study, column, view, mask = null) => {
  const { x, y, from, to, most } = view;
  const size = [to[0] - from[0], to[1] - from[1]], step = size.map((one, i) => Math.ceil(one / most[i]));
  const cells = size.map((one, i) => Math.ceil(one / step[i]));
  // where points lie that a cell is made of
  let offsets = [0];
  for (const dim of study.dims) {
    if (dim === x || dim === y) continue;
    const along = view.at[dim.i] === "all" ? Array.from({ length: dim.size }, (_, i) => i * dim.stride) : [view.at[dim.i] * dim.stride];
    offsets = offsets.flatMap((one) => along.map((more) => one + more));
  }
  const values = new Float32Array(cells[0] * cells[1]), out = mask && new Uint8Array(values.length), gathered = new Float32Array(offsets.length * step[0] * step[1]), how = reduced[view.how];
  for (let j = 0; j < cells[1]; j++) {
    for (let i = 0; i < cells[0]; i++) {
      let count = 0, passed = 0;
      for (let b = from[1] + j * step[1]; b < Math.min(from[1] + (j + 1) * step[1], to[1]); b++) {
        for (let a = from[0] + i * step[0]; a < Math.min(from[0] + (i + 1) * step[0], to[0]); a++) {
          const base = a * x.stride + b * y.stride;
          for (let k = 0; k < offsets.length; k++) {
            if (mask && !mask[base + offsets[k]]) continue;
            passed++;
            const value = column[base + offsets[k]];
            if (value === value) gathered[count++] = value;
          }
        }
      }
      values[j * cells[0] + i] = count === 1 ? gathered[0] : how(gathered.subarray(0, count));
      if (out && !passed) out[j * cells[0] + i] = 1;
    }
  }
  return { values, cells, step, out };
};

/** A value as TOML: a whole number stands for a real one, too. */
const exact = (value) => (typeof value === "number" ? String(value) : JSON.stringify(value));
const assigned = (table) => Object.entries(table).map(([key, value]) => `${key} = ${exact(value)}`);
/** A point, its values by path, as a study that includes this one; it has all of its `effects` if one of them is varied. */
const pointText = (values, effects) => {
  const lines = ['include = "study.toml"', "axes = []", "figures = []", "notes = []"], tables = effects.map((one) => ({ ...one }));
  let varied = false;
  for (const [path, value] of Object.entries(values)) {
    const [, name, key] = /^effects\.(.+)\.([^.]+)$/.exec(path) ?? [];
    // two of a kind go by their numbers
    if (name) tables[/^\d+$/.test(name) ? Number(name) : tables.findIndex(({ kind }) => kind === name)][key] = value;
    else lines.push(`${path} = ${exact(value)}`);
    varied ||= Boolean(name);
  }
  for (const one of varied ? tables : []) lines.push("", "[[effects]]", ...assigned(one));
  return `${lines.join("\n")}\n`;
};

/** Gains of a point, for a study to include. */
const gainsText = (gains, values) => {
  const chosen = (side, own) => Object.fromEntries(["lambda", "alpha"].map((name) => [name, values[`observer.${side}.${name}`] ?? own[name]]));
  const tables = Object.entries(gains).map(([side, own]) => ["", `[observer.${side}]`, ...assigned(chosen(side, own)), ""].join("\n"));
  return `# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.\n${tables.join("")}`;
};
