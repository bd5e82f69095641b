"use strict";
/* The points of a study: its axes and metrics by name, a filter, and what is saved of a point. */

/** A study: `fields` by name, of axes and metrics: { name, label, unit, names, log, metric, read }; `read` gives a function of the
 * row. Over a grid there are `dims`, its axes as dimensions of an array; those that advance together are one. */
class Study {
  constructor(about) {
    Object.assign(this, about);
    // of very many rows few columns fit into memory
    this.columns = new Columns(about, about.rows > 2e6 ? 8 : 40);
    this.colours = coloursOf(about);
    const sizes = about.grid ? about.axes.map(({ paths: [{ values }] }) => values.length) : [];
    this.dims = sizes.map((_, i) => dimension(about.axes[i], i, sizes.slice(i + 1).reduce((a, b) => a * b, 1)));
    const stored = (name, Kind) => async () => { const column = await this.columns.get(name, Kind); return (row) => column[row]; };
    const ofGrid = ({ size, log, indexOf, paths }) => paths.map(({ path: name, label, unit, values }) => {
      const names = values.every(Number.isFinite) ? null : values;
      return { name, label, unit, names, log, varied: size > 1, read: async () => (names ? indexOf : (row) => values[indexOf(row)]) };
    });
    const ofTable = ({ path: name, label, unit, words: names, log }) => ({ name, label, unit, names, log, varied: true, read: stored(name, Float64Array) });
    this.axes = about.grid ? this.dims.flatMap(ofGrid) : [...about.axes, { path: "seed", label: "seed", unit: "" }].map(ofTable);
    const metrics = about.metrics.map((one) => ({ ...one, unit: "", metric: true, read: stored(one.name, Float32Array) }));
    this.fields = new Map([...this.axes, ...metrics].map((one) => [one.name, one]));
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
      const read = await Promise.all(all.map(({ field }) => field.read()));
      for (let row = 0; row < this.rows; row++) if (all.every(({ passes }, k) => passes(read[k](row)))) out[row] = 1;
    }
    return out;
  }
}

/** A dimension of a grid, whose places are so many rows apart: along evenly spaced values it is drawn as they are, else as their
 * numbers. */
const dimension = ({ paths }, i, stride) => {
  const { path, label, unit, values } = paths[0], size = values.length, last = size - 1, ends = [values[0], values[last]], ratio = values[0] > 0 ? ends[1] / ends[0] : 0;
  const rising = values.every((one, k) => Number.isFinite(one) && (!k || one > values[k - 1]));
  const isEven = ({ share }) => size > 1 && rising && values.every((one, k) => Math.abs(share(one) * last - k) < 1e-3);
  const log = size > 2 && ratio > 3 && isEven(along({ ends, log: true })), spaced = log || isEven(along({ ends })), scale = spaced ? along({ ends, log }) : along({ ends: [0, 1] }), steps = spaced ? last : 1;
  // between values that are not even, in their own scale
  const between = (value) => {
    const k = Math.min(before(values, value), last - 1);
    return k + along({ ends: [values[k], values[k + 1]], log: ratio > 20 }).share(value);
  };
  return {
    i, size, stride, paths, name: paths.map((one) => one.path).join(", "), path, values, seed: path === "seed", log, rising,
    axis: { label: paths.length > 1 ? `${label}, with ${paths.slice(1).map((one) => one.path).join(", ")}` : label, key: path, log, names: spaced ? null : values.map(text) },
    /** The place of a row along the axis; where a place is drawn, and which one is drawn there; where a value is. */
    indexOf: (row) => Math.floor(row / stride) % size, edge: (k) => scale.value(k / steps), index: (at) => clamped(Math.round(scale.share(at) * steps), 0, last),
    place: (value) => (spaced ? value : between(value)),
    said: (k) => paths.map((one) => `${text(one.values[k])} ${one.unit}`.trim()).join(", "),
  };
};

/** One number of several, nan left out. */
const reduced = {
  median: (values) => 0.5 * (values.sort()[(values.length - 1) >> 1] + values[values.length >> 1]),
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
  for (const dim of study.dims.filter((one) => one !== x && one !== y)) {
    const places = view.at[dim.i] === "all" ? [...dim.values.keys()] : [view.at[dim.i]];
    offsets = offsets.flatMap((one) => places.map((place) => one + place * dim.stride));
  }
  const values = new Float32Array(cells[0] * cells[1]), out = mask && new Uint8Array(values.length), gathered = new Float32Array(offsets.length * step[0] * step[1]), how = reduced[view.how];
  for (let cell = 0; cell < values.length; cell++) {
    const left = from[0] + (cell % cells[0]) * step[0], low = from[1] + Math.floor(cell / cells[0]) * step[1];
    let count = 0, passed = 0;
    for (let j = low; j < Math.min(low + step[1], to[1]); j++) {
      for (let i = left; i < Math.min(left + step[0], to[0]); i++) {
        for (const offset of offsets) {
          const row = i * x.stride + j * y.stride + offset;
          if (mask && !mask[row]) continue;
          passed++;
          if (!Number.isNaN(column[row])) gathered[count++] = column[row];
        }
      }
    }
    values[cell] = count === 1 ? gathered[0] : how(gathered.subarray(0, count));
    if (out && !passed) out[cell] = 1;
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
