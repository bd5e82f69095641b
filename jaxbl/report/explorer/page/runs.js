"use strict";
/* Runs that the server simulates anew: traces, hysteresis, error in the phase plane; some pinned beside the newest. */

const SIDES = ["motor", "load"];
/** What is drawn of a run: title, axes, and lines [name, column of x, column of y, dashed]; of the last half where the first is transient. */
const tracePlots = (columns) => {
  const sides = SIDES.filter((one) => `${one}.velocity` in columns), what = "z" in columns ? "transmitted torque" : "disturbance torque";
  const over = (title, unit, lines) => ({ title: withUnit(title, unit), time: true, x: { name: "time", unit: "s" }, y: { name: title, unit }, lines: lines.map(([name, y, dash]) => [name, "t", y, dash]) });
  const signal = (side, name, unit) => over(`${side}: ${name}`, unit, [["observed", `${side}.${name}_estimate`, false], ["true", `${side}.${name}`, true]]);
  return [
    ...sides.flatMap((side) => [signal(side, "velocity", "rad/s"), over(`${side}: velocity error, true less observed`, "rad/s", [["error", `${side}.velocity_error`, false]])]),
    over(what, "N m", [...SIDES.map((side) => [`by the ${side} observer`, `${side}.torque_estimate`, false]), ["true", "torque", true]]),
    ...("z" in columns ? [{ title: `hysteresis, second half: ${what} (N m)`, half: true, x: { label: "twist z", unit: "rad" }, y: { name: what, unit: "N m" }, lines: [["by the motor observer", "z", "motor.torque_estimate", false], ["true", "z", "torque", true]] }] : []),
    ...sides.map((side) => signal(side, "position", "rad")),
  ];
};
/** A metric's figure of a run as maps draw it: sizes of what has a sign, 1 and 0 of what is true or not, nan where there is none. */
const drawnFigure = ({ yes, size }, raw) => (yes ? Number(raw) : raw === null ? NaN : size ? Math.abs(raw) : raw);

class Runs {
  /** `changed` hears that other runs are pinned. */
  constructor(study, changed = () => {}) {
    Object.assign(this, { study, changed, all: [] });
    $("against").onchange = () => this.draw();
    $("runcsv").onclick = () => saveTable("run.csv", this.newest.columns);
    $("runpicture").onclick = () => savePicture("run.png", $("runs"));
  }
  pinned() { return this.all.filter((one) => one.pinned).map((one) => one.row); }
  /** Pins the newest run. */
  pin() { if (this.newest) { this.newest.pinned = true; this.draw(); } }
  /** Has the run of a point simulated, `values` by path; it takes the place of the newest, unless that is pinned. `stored` is
   * what the sweep has of a metric: { metric, value }. */
  async simulate(values, seed, stored, row) {
    const asked = (this.asked = Symbol("asked"));
    $("runs").hidden = false;
    $("told").textContent = "simulating …";
    $("point").disabled = true;
    const began = performance.now();
    const answered = async (what) => {
      const answer = await fetch(what, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ values, seed }) }), found = await answer.json();
      if (!answer.ok) throw new Error(found.error);
      return found;
    };
    const ask = (what) => (this.waiting = answered(what));
    // one is computed at a time: of clicks meanwhile the last one counts
    await this.waiting?.catch(() => null);
    if (asked !== this.asked) return;
    const found = await ask("simulated").catch((error) => ({ error: error.message }));
    if (asked !== this.asked) return;
    if (found.error) { $("told").textContent = `Not simulated: ${found.error}`; return; }
    this.all = this.all.filter((one) => one.pinned && one.row !== row);
    if (this.all.length === COLOURS.length) this.all.shift();
    const columns = Object.fromEntries(Object.entries(found.columns).map(([name, bytes]) => [name, unpacked(bytes)]));
    const name = [...this.study.named.map((path) => `${path.replace(/^observer\./, "")} ${text(values[path])}`), `seed ${seed}`].join(", ");
    this.newest = { ...found, row, name, columns, colour: COLOURS.find((colour) => !this.all.some((one) => one.colour === colour)), pinned: false };
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
  /** The runs that are drawn: pinned ones first and thin, so that the newest lies between them and the truth; or what they differ by. */
  draw() {
    const { newest } = this, range = this.group?.[0]?.range, others = this.all.filter((one) => one !== newest), apart = others.length && $("against").value;
    $("apart").hidden = !others.length;
    for (const name of ["runcsv", "runpicture"]) $(name).hidden = false;
    $("pinned").replaceChildren(...this.all.map((one) => this.entry(one)));
    $("traces").replaceChildren();
    const plots = [], group = (this.group = []);
    const add = (spec, lines) => {
      const title = apart ? `${spec.title}, pinned less newest` : spec.title, together = spec.time ? { group, range: range ? [range[0], null] : null } : {};
      plots.push({ height: 128, ...spec, title, lines, ...together });
    };
    const named = (run, name) => (others.length ? `${run.name}: ${name}` : name);
    for (const spec of tracePlots(newest.columns).filter((one) => !apart || one.time)) {
      const part = (column) => (spec.half ? column.subarray(column.length >> 1) : column), sides = spec.lines.filter((one) => one[2] in newest.columns).length > 2;
      add({ ...spec, named: sides && !others.length }, (apart ? others : [newest, ...others]).flatMap((run) => spec.lines.filter(([,, y]) => y in run.columns).map(([name, x, y, dashed], i) => {
        const own = part(run.columns[y]), at = part(run.columns[x]), values = apart ? this.less(own, at, newest.columns[y], newest.columns[x]) : own;
        // two observers of one quantity
        const colour = !others.length && sides && !dashed ? COLOURS[i] : others.length || !dashed ? run.colour : undefined;
        return { name: named(run, name), x: at, y: values, colour, dash: dashed ? [6, 4] : [], width: run === newest ? 2 : 1, sorted: x === "t" };
      })));
    }
    for (const side of SIDES.filter((one) => newest.planes[one] && !apart)) {
      const drawn = [newest, ...others].filter((run) => run.planes[side]), bounded = drawn.some((run) => run.planes[side].majorant[0]);
      const [x, y] = [0, 1].map((i) => Math.max(...drawn.map((run) => run.planes[side].reach[i]))).map((reach) => (reach > 0 ? [-reach, reach] : null));
      const title = `${side}: error of the observer in the phase plane${bounded ? ", dashed: majorant of the proof (36)-(37)" : "; no peak stands out from the chatter"}`;
      add({ title, x: { label: "position error e", unit: "rad", ends: x }, y: { name: "its slope ė", unit: "rad/s", ends: y } }, drawn.flatMap((run) => {
        const { error, slope, majorant } = run.planes[side], line = (name, along, up, look) => ({ name: named(run, name), x: unpacked(along), y: unpacked(up), colour: run.colour, ...look });
        const lines = [line("error", error, slope, { width: run === newest ? 1.5 : 1 })];
        return majorant[0] ? [...lines, line("majorant", ...majorant, { dash: [2, 3], ...(others.length ? {} : { colour: GREY }) })] : lines;
      }));
    }
    // their widths are known when all are there
    const figures = plots.map(() => addFigure($("traces")));
    this.plots = plots.map((given, i) => new Chart(figures[i], given));
    const { metrics } = newest, cell = (name, own) => (typeof own[name] === "boolean" ? (own[name] ? "yes" : "no") : text(drawnFigure(this.study.metric(name) ?? {}, own[name])));
    tableOf($("metrics"), ["metric", ...this.all.map((one) => one.name)], Object.keys(metrics).map((name) => [this.study.metric(name)?.label ?? name, ...this.all.map((one) => cell(name, one.metrics))]));
  }
  /** A signal less another one, which is taken between its samples where the two have other times. */
  less(own, at, other, times) {
    return own.map((value, i) => {
      const k = Math.min(before(times, at[i]), times.length - 2), share = (at[i] - times[k]) / (times[k + 1] - times[k]);
      return share > 1 + 1e-9 ? NaN : value - (other[k] + share * (other[k + 1] - other[k] || 0));
    });
  }
  entry(one) {
    return made("li", {}, markOf(one.colour), one.name, " ", button(one.pinned ? "unpin" : "pin", () => {
      one.pinned = !one.pinned;
      this.all = this.all.filter((other) => other.pinned || other === this.newest);
      this.changed();
      this.draw();
    }));
  }
}
