"use strict";
/* Lines, dots and cells over two axes, drawn by uPlot: values under the pointer and by arrow keys, drag to enlarge. */

/** Okabe and Ito's colours, which colour-blind readers can tell apart. */
const COLOURS = ["#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
const GREY = "#8a8d93";

/** Least and largest of numbers that are finite, and above 0 where that is asked for. */
const endsOf = (columns, log = false) => {
  let [low, high] = [Infinity, -Infinity];
  for (const values of columns) {
    for (const one of values) if (Number.isFinite(one) && (!log || one > 0)) { if (one < low) low = one; if (one > high) high = one; }
  }
  return [low, high];
};

/** The same with some length: of no number, or of one. */
const widened = ([low, high], log = false) => {
  if (!(low <= high)) return log ? [1, 10] : [0, 1];
  const more = 0.5 * Math.abs(low) || 0.5;
  return low < high ? [low, high] : log ? [low / 2, 2 * high] : [low - more, high + more];
};

/** Round values between two ends; on a logarithmic axis decades, of few decades 2 and 5 as well. */
const ticks = (low, high, log, most = 6) => {
  const decades = log ? Math.log10(high / low) : 0, every = Math.ceil(decades / most), factors = decades < 2.5 ? [1, 2, 5] : [1];
  if (decades > 0.7) {
    const powers = Array.from({ length: Math.ceil(decades) + 2 }, (_, k) => Math.floor(Math.log10(low)) + k).filter((power) => power % every === 0);
    return powers.flatMap((power) => factors.map((one) => Number(`${one}e${power}`))).filter((one) => one >= low && one <= high);
  }
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough)), step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough * (1 - 1e-9));
  const first = Math.ceil(low / step - 1e-9), count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: Math.max(0, Math.min(most + 1, count)) || 0 }, (_, k) => Number(((first + k) * step).toPrecision(12)));
};

/** How uPlot draws a line: by itself, where its x are sorted; else by pieces, of which none is so long that it would sort it. */
const pathOf = (line, draw = uPlot.paths.linear()) => (plot, number, first, last) => {
  const { min, max } = plot.scales.x, { x } = line;
  if (line.sorted) return draw(plot, number, Math.max(before(x, min) - 1, first), Math.min(before(x, max) + 2, last));
  const stroke = new Path2D();
  for (let i = first, piece = Math.ceil(3 * plot.bbox.width); i < last; i += piece) stroke.addPath(draw(plot, number, i, Math.min(i + piece, last)).stroke);
  return { stroke, flags: 1 };
};
/** Dots, squares of so many pixels; of a colour each where the chart has a scale. */
const dotsOf = (chart, line) => (plot) => {
  const { ctx } = plot, size = line.dots * devicePixelRatio, { x, y } = line;
  ctx.save();
  chart.clip(plot);
  ctx.fillStyle = line.colour ?? getComputedStyle(document.body).color;
  ctx.globalAlpha = line.alpha ?? 1;
  for (let i = 0; i < x.length; i++) {
    if (line.shade) ctx.fillStyle = `rgb(${chart.scale.colour(line.shade[i]).join(",")})`;
    const [left, top] = chart.at(x[i], y[i], true);
    ctx.fillRect(left - size / 2, top - size / 2, size, size);
  }
  ctx.restore();
  return null;
};

/**
 * `x` and `y` are { label, name, key, unit, names, log, ends, hidden }: the label stands along the axis, the name beside a value; names stand
 * for the numbers 0, 1, ..., or as a Map for others; ends leave out what lies beyond, and may fall.
 * A line is { name, x, y, colour, alpha, dash, width, dots, shade, sorted, said }, and `shades` behind lines are { along, low, high },
 * or { x, low, high } as columns, with { name, colour, alpha }; `named` says the names of both above.
 * Cells, behind the lines, are { x, y, size, colours, text }: ends along both axes, numbers of cells, the canvas of one pixel a
 * cell, and what is said of the cell [i, j], null of none. `scale` has the colours of dots with a shade.
 * `marks`, [x, y, kind] each, are drawn last: "ring", "ghost" or "star". Charts of a `group` over the same quantity are enlarged
 * together; `zoomed` hears the ends in place of that, null of the whole. `picked` hears what is clicked: { line, i } or { cell }.
 */
class Chart {
  constructor(element, { height = 240, caption = "", title = "", lines = [], ...given }) {
    for (const axis of [given.x, given.y]) if (Array.isArray(axis.names)) axis.names = new Map(axis.names.entries());
    Object.assign(this, { height, lines: lines.filter((one) => one.x.length), shades: [], range: null, cells: null, scale: null, marks: [], group: [], ...given });
    for (const axis of [this.x, this.y]) axis.name ??= axis.label;
    this.group.push(this);
    this.box = made("div", { className: "values", hidden: true, ariaLive: "polite" });
    this.view = made("div", { className: "plane", tabIndex: 0 }, this.box);
    this.view.setAttribute("role", "application");
    // uPlot sizes itself later
    this.view.style.height = `${this.height}px`;
    const over = title ? [made("p", { className: "over", textContent: title })] : [], below = caption ? [made("figcaption", { textContent: caption })] : [];
    element.replaceChildren(...over, this.legend(), this.view, ...below);
    this.listen();
    this.build();
    new ResizeObserver(() => { if (this.plot?.width !== this.view.clientWidth) this.build(); }).observe(this.view);
  }
  /** Names of lines and of what is shaded, each once. */
  legend() {
    const named = [...this.lines, ...this.shades.map((one) => ({ colour: GREY, ...one }))].filter((one) => this.named && one.name);
    const entries = new Map(named.map(({ name, colour, dash }) => [name, made("span", {}, markOf(colour ?? "currentColor", dash?.length), name)]));
    return made("p", { className: "legend" }, ...entries.values());
  }
  /** Ends of both axes of what is shown. */
  ends() {
    return ["x", "y"].map((name, i) => {
      const axis = this[name];
      if (this.range?.[i]) return this.range[i];
      if (axis.ends) return axis.ends;
      const shaded = this.shades.filter((one) => one.x).flatMap((one) => (i ? [one.low, one.high] : [one.x]));
      const ends = widened(endsOf([...this.lines.map((one) => one[name]), ...shaded], axis.log), axis.log), { value } = along({ ends, log: axis.log });
      const room = axis.names ? 0.5 / (ends[1] - ends[0]) : i || this.lines.some((one) => one.dots) ? 0.04 : 0;
      return [value(-room), value(1 + room)];
    });
  }
  axis(name, i, ends) {
    const { label, unit, names, log } = this[name], colour = () => getComputedStyle(document.body).color, font = "12px system-ui, sans-serif";
    return {
      scale: name, show: !this[name].hidden, stroke: colour, font, labelFont: font, labelSize: 18, size: i ? 58 : this[name].turn ? 64 : 28, rotate: this[name].turn, gap: 3, side: i ? 3 : 2, space: i ? 32 : 70,
      label: label ? withUnit(label, unit) : undefined,
      grid: { show: !this.cells, stroke: `${GREY}40`, width: 1 }, ticks: { stroke: `${GREY}80`, width: 1, size: 4 },
      ...(names ? { splits: () => { const inside = [...names.keys()].filter((one) => one >= ends[0] && one <= ends[1]), every = Math.ceil((inside.length * (i ? 18 : 44)) / (i ? this.height : this.view.clientWidth)); return inside.filter((_, k) => k % every === 0); } } : {}),
      ...(log ? { splits: () => ticks(...ends, true, i ? this.height / 40 : this.view.clientWidth / 80), filter: (_, splits) => splits } : {}),
      values: (_, splits) => splits.map((one) => names ? (names.get(one) ?? "") : textBetween(one, ends)),
    };
  }
  build() {
    const width = this.view.clientWidth;
    if (!width) return;
    const colour = getComputedStyle(document.body).color, given = this.ends(), ends = (this.shown = given.map(([low, high]) => [Math.min(low, high), Math.max(low, high)])), lines = this.lines.length ? this.lines : [{ x: [], y: [] }];
    this.plot?.destroy();
    this.plot = new uPlot({
      mode: 2, width, height: this.height, legend: { show: false }, padding: [8, 14, 0, this.y.hidden ? 14 : 0], pxAlign: 0,
      scales: Object.fromEntries(["x", "y"].map((name, i) => [name, { time: false, dir: given[i][0] > given[i][1] ? -1 : 1, distr: this[name].log ? 3 : 1, range: () => ends[i] }])),
      axes: ["x", "y"].map((name, i) => this.axis(name, i, ends[i])),
      cursor: { x: false, y: false, points: { show: false }, dataIdx: () => null, drag: { x: true, y: true, dist: 8, uni: 12, setScale: false }, bind: { dblclick: () => () => this.zoom(null) } },
      series: [null, ...lines.map((line) => ({
        facets: ["x", "y"].map((scale) => ({ scale, auto: true })), stroke: line.colour ?? colour, width: line.dots ? 0 : line.width ?? 1.5, dash: line.dash, alpha: line.alpha ?? 1,
        spanGaps: !line.sorted, gaps: (plot, i, first, last, gaps) => gaps, points: { show: false }, paths: line.dots ? dotsOf(this, line) : pathOf(line),
      }))],
      hooks: { drawClear: [(plot) => this.behind(plot)], draw: [(plot) => this.above(plot)], setSelect: [(plot) => this.select(plot)] },
      // uPlot knows gaps as null
    }, [null, ...lines.map(({ x, y }) => [x, y.some((one) => !Number.isFinite(one)) ? Array.from(y, (one) => (Number.isFinite(one) ? one : null)) : y])], this.view);
    const said = this.scale ? `colours: ${withUnit(this.scale.label, this.scale.unit)}, ${this.scale.said}` : this.lines.map((one) => one.name).filter(Boolean).join(", ");
    this.view.setAttribute("aria-label", `${withUnit(this.y.label ?? "", this.y.unit)} over ${withUnit(this.x.label ?? "", this.x.unit)}, from ${text(ends[1][0])} to ${text(ends[1][1])}: ${said}; arrow keys read values, 0 shows the whole`);
  }
  /** Marks other points. */
  mark(marks) { this.marks = marks; this.plot?.redraw(false); }
  /** The place of a point in the view, or in the canvas, in pixels. */
  at(x, y, canvas = false) { return [this.plot.valToPos(x, "x", canvas), this.plot.valToPos(y, "y", canvas)]; }
  clip({ ctx, bbox }) { ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip(); }
  behind(plot) {
    const { ctx, bbox } = plot;
    ctx.save();
    this.clip(plot);
    if (this.cells) {
      const [left, bottom] = this.at(this.cells.x[0], this.cells.y[0], true), [right, top] = this.at(this.cells.x[1], this.cells.y[1], true);
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(this.cells.colours, left, top, right - left, bottom - top);
      if (this.cells.hatched) {
        // strokes where the mask is
        const strokes = made("canvas", { width: ctx.canvas.width, height: ctx.canvas.height }), own = strokes.getContext("2d"), high = bbox.height;
        Object.assign(own, { imageSmoothingEnabled: false, strokeStyle: "#ffffffb0", lineWidth: devicePixelRatio });
        own.beginPath();
        for (let k = -high; k < bbox.width; k += 9 * devicePixelRatio) { own.moveTo(bbox.left + k, bbox.top + high); own.lineTo(bbox.left + k + high, bbox.top); }
        own.stroke();
        own.globalCompositeOperation = "destination-in";
        own.drawImage(this.cells.hatched, left, top, right - left, bottom - top);
        ctx.drawImage(strokes, 0, 0);
      }
    }
    for (const { along = "x", x, low, high, colour = GREY, alpha = 0.25 } of this.shades) {
      Object.assign(ctx, { fillStyle: colour, strokeStyle: colour, globalAlpha: alpha, lineWidth: devicePixelRatio });
      ctx.beginPath();
      if (x) {
        // there and back
        const known = [...x.keys()].filter((i) => Number.isFinite(low[i]) && Number.isFinite(high[i]));
        for (const i of known) ctx.lineTo(...this.at(x[i], high[i], true));
        for (const i of known.reverse()) ctx.lineTo(...this.at(x[i], low[i], true));
        ctx.fill();
      } else {
        const [from, to] = [low, high].map((one) => plot.valToPos(one, along, true)), size = Math.max(Math.abs(to - from), 1.5 * devicePixelRatio);
        if (along === "x") ctx.fillRect(Math.min(from, to), bbox.top, size, bbox.height); else ctx.fillRect(bbox.left, Math.min(from, to), bbox.width, size);
      }
    }
    ctx.restore();
  }
  above(plot) {
    const { ctx, bbox } = plot, unit = devicePixelRatio;
    ctx.save();
    for (const [x, y, kind] of this.marks) {
      const [left, top] = this.at(x, y, true);
      if (!(left >= bbox.left - 1 && left <= bbox.left + bbox.width + 1 && top >= bbox.top - 1 && top <= bbox.top + bbox.height + 1)) continue;
      ctx.beginPath();
      if (kind === "star") for (let k = 0; k < 10; k++) { const size = (k % 2 ? 4 : 9) * unit, turn = (k * Math.PI) / 5; ctx.lineTo(left + size * Math.sin(turn), top - size * Math.cos(turn)); }
      else ctx.arc(left, top, (kind === "ghost" ? 3.5 : 6) * unit, 0, 2 * Math.PI);
      ctx.closePath();
      for (const [colour, width] of kind === "star" ? [["#000000", 3]] : [["#000000", 5], ["#ffffff", 2]]) { Object.assign(ctx, { strokeStyle: colour, lineWidth: width * unit }); ctx.stroke(); }
      if (kind === "star") { ctx.fillStyle = "#ffffff"; ctx.fill(); }
    }
    ctx.restore();
    this.drawn?.(plot);
  }
  select(plot) {
    const { left, top, width, height } = plot.select;
    if (width < 1 && height < 1) return;
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    const over = plot.over, whole = [width >= over.clientWidth - 1, height >= over.clientHeight - 1];
    const places = [[left, left + width], [top + height, top]];
    // a drag along one axis keeps the other one
    this.zoom(places.map((ends, i) => (whole[i] ? this.range?.[i] ?? null : ends.map((one) => plot.posToVal(one, "xy"[i])))));
  }
  zoom(range) {
    this.range = range;
    this.show(null);
    if (this.zoomed) return this.zoomed(range);
    const { name, log } = this.x;
    for (const one of this.group.filter((other) => other === this || (name && other.x.name === name && other.x.log === log))) {
      if (one !== this) one.range = range && [range[0], null];
      one.build();
    }
  }
  /** What lies at a place in pixels of the plotting area: a cell, or the nearest sample, none farther than 40 pixels. */
  nearest([left, top]) {
    const value = [this.plot.posToVal(left, "x"), this.plot.posToVal(top, "y")];
    if (this.cells) {
      const cell = ["x", "y"].map((name, i) => Math.floor(this.cells.size[i] * along({ ends: this.cells[name], log: this[name].log }).share(value[i])));
      return cell.every((one, i) => one >= 0 && one < this.cells.size[i]) && this.cells.text(cell) ? { cell, place: value } : null;
    }
    return nearestOf(this.lines, [left, top], 40, (x, y) => this.at(x, y), [-40, 40].map((more) => this.plot.posToVal(left + more, "x")));
  }
  show(found) {
    if (!found || !this.plot) { this.box.hidden = true; return; }
    const { line, i, cell } = found, { over } = this.plot, place = cell ? found.place : [line.x[i], line.y[i]];
    const axes = [this.x, this.y].map((axis, k) => saidOf(axis, place[k], this.shown[k]));
    const lines = cell ? this.cells.text(cell) : [line.name, ...(line.said?.(i) ?? []), ...axes].filter(Boolean);
    const at = this.at(...place);
    beside(this.box, lines, [at[0] + over.offsetLeft, at[1] + over.offsetTop], this.view);
  }
  listen() {
    const { view } = this;
    let from = null, chosen = null;
    const place = (event) => placeIn(this.plot.over, event);
    view.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY]; });
    view.addEventListener("pointermove", (event) => { if (this.plot && !event.buttons) this.show(this.nearest(place(event))); });
    view.addEventListener("click", (event) => {
      const found = this.plot && from && Math.hypot(event.clientX - from[0], event.clientY - from[1]) < 8 && this.nearest(place(event));
      if (found) this.picked?.(found);
    });
    view.addEventListener("pointerleave", () => this.show(null));
    view.addEventListener("blur", () => { chosen = null; this.show(null); });
    view.addEventListener("keydown", (event) => {
      const [step, turn] = STEPS[event.key] ?? [0, 0], { lines } = this;
      if (event.key === "0" || event.key === "Escape") this.zoom(null);
      else if ((step || turn) && this.cells?.move) this.cells.move(step, -turn);
      else if ((step || turn) && lines.length) {
        const line = chosen ? lines.at((lines.indexOf(chosen.line) + turn) % lines.length) : lines[0], { length } = line.x;
        chosen = { line, i: chosen ? clamped(chosen.i + step * Math.max(1, Math.floor(length / 100)), 0, length - 1) : 0 };
        this.show(chosen);
      } else if (event.key === "Enter" && (this.cells || chosen)) this.picked?.(chosen ?? {});
      else return;
      event.preventDefault();
    });
  }
}
