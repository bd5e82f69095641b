"use strict";
/* Runs that the server simulates anew: traces, hysteresis, error in the phase plane; some pinned beside the newest. */

const SIDES = ["motor", "load"];
/** What is drawn of a run: title, axes, and lines [name, column of x, column of y, dashed]; of the last half where the first is transient. */
const tracePlots = (columns) => {
  const sides = SIDES.filter((side) => `${side}.velocity` in columns), time = { label: "time", unit: "s" }, plots = [];
  const over = (caption, label, unit, lines) => plots.push({ caption, time: true, x: time, y: { label, unit }, lines: lines.map(([name, y, dash]) => [name, "t", y, dash]) });
  for (const side of sides) {
    const symbol = side === "motor" ? "θe" : "θs";
    over(`${side}: position`, `position ${symbol}`, "rad", [["observed", `${side}.position_estimate`, false], ["true", `${side}.position`, true]]);
    over(`${side}: velocity`, "velocity", "rad/s", [["observed", `${side}.velocity_estimate`, false], ["true", `${side}.velocity`, true]]);
    over(`${side}: error of the velocity, true less observed`, "velocity error", "rad/s", [["error", `${side}.velocity_error`, false]]);
  }
  const what = "z" in columns ? "transmitted torque" : "disturbance torque";
  over(`${what}, true and observed`, what, "N m", [...sides.map((side) => [`by the ${side} observer`, `${side}.torque_estimate`, false]), ["true", "torque", true]]);
  if ("z" in columns) {
    plots.push({ caption: "hysteresis: torque over twist, second half of the run", half: true, x: { label: "twist z", unit: "rad" }, y: { label: what, unit: "N m" },
      lines: [["by the motor observer", "z", "motor.torque_estimate", false], ["true", "z", "torque", true]] });
  }
  return plots;
};

/** A value as TOML: a whole number stands for a real one, too. */
const exact = (value) => (typeof value === "number" ? String(value) : JSON.stringify(value));

/** A point in words: axes as { path, unit }, values by path. */
const pointWords = (axes, values) => axes.map(({ path, unit }) => `${path}: ${text(values[path])} ${unit}`.trim()).join(", ");

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
  for (const one of varied ? tables : []) lines.push("", "[[effects]]", ...Object.entries(one).map(([key, value]) => `${key} = ${exact(value)}`));
  return `${lines.join("\n")}\n`;
};

/** Gains of a point, for a study to include. */
const gainsText = (gains, values) => {
  const tables = Object.entries(gains).map(([side, own]) => {
    const [lambda, alpha] = ["lambda", "alpha"].map((name) => exact(values[`observer.${side}.${name}`] ?? own[name]));
    return `[observer.${side}]\nlambda = ${lambda}\nalpha = ${alpha}\n`;
  });
  return `# To use them, put include = "gains.toml" at the top of a study and leave its own gains out.\n\n${tables.join("\n")}`;
};

/** A metric's figure of a run as maps draw it: sizes of what has a sign, 1 and 0 of what is true or not, nan where there is none. */
const drawnFigure = ({ yes, size }, raw) => (yes ? Number(raw) : raw === null ? NaN : size ? Math.abs(raw) : raw);

class Runs {
  constructor(study) {
    Object.assign(this, { study, all: [], plots: [] });
  }
  /** Has the run of a point simulated, `values` by path; it takes the place of the newest, unless that is pinned. `stored` is
   * what the sweep has of a metric: { metric, value }. */
  async simulate(values, seed, stored) {
    const asked = (this.asked = Symbol("asked"));
    $("runs").hidden = false;
    $("told").textContent = "simulating …";
    $("point").disabled = true;
    const began = performance.now();
    const answered = async (what) => {
      const answer = await fetch(what, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ values, seed }) });
      const found = await answer.json();
      if (!answer.ok) throw new Error(found.error);
      return found;
    };
    const ask = (what) => (this.waiting = answered(what));
    // one is computed at a time: of clicks meanwhile the last one counts
    await this.waiting?.catch(() => null);
    if (asked !== this.asked) return;
    let found;
    try {
      found = await ask("simulated");
    } catch (error) {
      if (asked === this.asked) $("told").textContent = `Not simulated: ${error.message}`;
      return;
    }
    if (asked !== this.asked) return;
    this.all = this.all.filter((one) => one.pinned);
    if (this.all.length === COLOURS.length) this.all.shift();
    const free = COLOURS.filter((colour) => !this.all.some((one) => one.colour === colour));
    const columns = Object.fromEntries(Object.entries(found.columns).map(([name, bytes]) => [name, unpacked(bytes)]));
    for (const side of SIDES.filter((one) => `${one}.velocity` in columns)) {
      columns[`${side}.velocity_error`] = columns[`${side}.velocity`].map((one, i) => one - columns[`${side}.velocity_estimate`][i]);
    }
    const name = [...this.study.named.map((path) => `${path.replace(/^observer\./, "")} ${text(values[path])}`), `seed ${seed}`].join(", ");
    this.newest = { ...found, name, columns, colour: free[0], pinned: false };
    this.all.push(this.newest);
    this.draw();
    const drawn = found.every > 1 ? `Every ${found.every}th sample is drawn. ` : "";
    $("told").textContent = `${drawn}Comparing with the sweep …`;
    $("point").disabled = false;
    document.body.dataset.simulated = `${name}, ${Math.round(performance.now() - began)} ms`;
    const compared = await this.compared(found, stored, ask).catch((error) => `Not compared: ${error.message}`);
    if (asked === this.asked) $("told").textContent = drawn + compared;
  }
  /** A metric as stored and of this run: they differ where rounding does, or where the run is not the one of the sweep. */
  async compared({ metrics }, { metric, value }, ask) {
    const { name, label } = metric, now = drawnFigure(metric, metrics[name]);
    const apart = Math.abs(now - value), both = `${label} is ${text(now)}, stored ${text(value)}`;
    if (apart <= 1e-3 * Math.abs(value) || (Number.isNaN(value) && !Number.isFinite(now))) return `${label}: ${text(now)}, as stored in the sweep.`;
    if (Number.isNaN(value)) return `${label}: ${text(now)}. The sweep has none: its run diverged, or is not there yet.`;
    const near = [now, ...(await ask("nearby")).metrics.map((one) => drawnFigure(metric, one[name]))].filter(Number.isFinite);
    const [low, high] = [Math.min(...near), Math.max(...near)], room = 0.5 * (high - low);
    const spread = `with λ and the motor's inertia changed in their last digits it is ${text(low)} to ${text(high)}`;
    return value >= low - room && value <= high + room ? `${both}. Rounding decides: ${spread}.` : `This run differs from the sweep's: ${both}; ${spread}.`;
  }
  config() { return this.newest.config; }
  draw() {
    const { columns } = this.newest, specs = tracePlots(columns), several = this.all.length > 1;
    const range = this.plots.find((one) => one.spec.time)?.range;
    $("pinned").replaceChildren(...this.all.map((one) => this.entry(one)));
    $("key").replaceChildren(legend([["solid: observed, or error", "currentColor", false], ["dashed: true", "currentColor", true], ["dots: majorant of the proof", "#8a8d93", true]]));
    const whole = $("traces");
    whole.replaceChildren();
    this.plots = [];
    const add = (spec, lines) => {
      const figure = made("figure");
      whole.append(figure);
      const plot = new Plot(figure, { ...spec, zoomed: spec.time && ((to) => this.follow(plot, to)) });
      plot.spec = spec;
      if (spec.time && range) plot.range = [range[0], null];
      plot.set(lines);
      this.plots.push(plot);
    };
    const named = (run, name) => (several ? `${run.name}: ${name}` : name);
    for (const spec of specs) {
      const sides = spec.lines.length > 2;
      add({ ...spec, named: sides && !several }, this.all.flatMap((run) => spec.lines.filter(([, , y]) => y in run.columns).map(([name, x, y, dashed], i) => {
        const part = (column) => (spec.half ? column.subarray(column.length >> 1) : column);
        // two observers of one quantity
        const colour = !several && sides && !dashed ? COLOURS[i] : several || !dashed ? run.colour : undefined;
        return { name: named(run, name), x: part(run.columns[x]), y: part(run.columns[y]), colour, alpha: dashed ? 1 : 0.8, dash: dashed ? [6, 4] : [], width: dashed ? 1.3 : 1.8, sorted: x === "t" };
      })));
    }
    for (const side of SIDES.filter((one) => this.newest.planes[one])) {
      const planes = this.all.map((run) => run.planes[side]).filter(Boolean), bounded = planes.some(({ majorant }) => majorant);
      const [x, y] = [0, 1].map((i) => Math.max(...planes.map(({ reach }) => reach[i]))).map((reach) => (reach > 0 ? [-reach, reach] : null));
      const spec = { caption: `${side}: error of the observer in the phase plane${bounded ? ", with the majorant of the proof (36)-(37)" : "; no peak stands out from the chatter"}`, height: 300,
        x: { label: "position error e", unit: "rad", limits: x }, y: { label: "its slope ė", unit: "rad/s", limits: y } };
      add(spec, this.all.filter((run) => run.planes[side]).flatMap((run) => {
        const { error, slope, majorant } = run.planes[side];
        const lines = [{ name: named(run, "error"), x: unpacked(error), y: unpacked(slope), colour: run.colour }];
        return majorant ? [...lines, { name: named(run, "majorant"), x: unpacked(majorant[0]), y: unpacked(majorant[1]), colour: several ? run.colour : "#8a8d93", dash: [2, 3] }] : lines;
      }));
    }
    this.table();
  }
  entry(one) {
    const mark = made("span", { className: "mark" });
    mark.style.borderTopColor = one.colour;
    const pin = made("button", { type: "button", textContent: one.pinned ? "unpin" : "pin" });
    pin.addEventListener("click", () => {
      one.pinned = !one.pinned;
      if (!one.pinned && one !== this.newest) this.all = this.all.filter((other) => other !== one);
      this.draw();
    });
    return made("li", {}, mark, one.name, pin);
  }
  /** All plots over time show what one of them does. */
  follow(from, range) {
    for (const plot of this.plots) {
      if (plot === from || !plot.spec.time) continue;
      plot.range = range && [range[0], null];
      plot.draw();
    }
  }
  table() {
    const { metrics } = this.newest;
    const cell = (name, own) => made("td", { className: "number", textContent: typeof own[name] === "boolean" ? (own[name] ? "yes" : "no") : text(drawnFigure(this.study.metric(name) ?? {}, own[name])) });
    $("metrics").replaceChildren(
      made("thead", {}, made("tr", {}, ...["metric", ...this.all.map((one) => one.name)].map((name) => made("th", { textContent: name, scope: "col" })))),
      made("tbody", {}, ...Object.keys(metrics).map((name) => made("tr", {}, made("th", { textContent: this.study.metric(name)?.label ?? name, scope: "row" }), ...this.all.map((one) => cell(name, one.metrics))))),
    );
  }
}
