"use strict";
/* A study as maps, as points over any two of its numbers, and over parallel axes; what is selected; and the page around them. */

const [MOST_FACETS, MOST_DOTS, MOST_PATHS, MOST_ROWS] = [6, 40000, 2000, 60];

/** Colours of a metric, or of another field. */
const scaleOf = (study, name, values, log) => {
  const { label, unit, names, yes } = study.fields.get(name);
  // a scale of logarithms has no place for zeros, and none for a sign
  const factor = name.endsWith(".factor"), positive = log && !yes && !values.some((one) => one < 0) ? values.filter((one) => one > 0) : [];
  return Scale.of(positive.length ? positive : values, { colours: study.colours, label, unit: study.fields.get(name).metric ? unit : "", names, ...(yes ? { low: 0, high: 1 } : {}), ...(log && !yes && !names ? (factor && positive.length ? { log: true } : {}) : { log: false }) });
};

/** What the three ways to show a study share. */
class View {
  constructor(page) { Object.assign(this, { page, study: page.study, panels: [] }); }
  /** Rows that pass the filter, at most so many, by a function that says whether a row is shown; and how many pass. */
  rows(mask, most, shown = () => true) {
    const { study } = this, rows = [], count = mask ? mask.reduce((sum, one) => sum + one, 0) : study.rows;
    // the first points of a design cover its ranges evenly
    const every = study.sampled ? 1 : Math.max(1, Math.ceil(count / most));
    for (let row = 0, passed = 0; row < study.rows && rows.length < most; row++) if ((!mask || mask[row]) && passed++ % every === 0 && shown(row)) rows.push(row);
    return { rows, count, said: rows.length < count ? `${rows.length} of ${count} points are drawn.` : "" };
  }
  /** Empty figures below the bar of the colours, as high as the window has room for. */
  figures(scale, count = 1) {
    const all = Array.from({ length: count }, () => made("figure"));
    scale.draw($("bar"));
    $("plot").className = count > 1 ? "plots several" : "plots";
    $("plot").replaceChildren(...all);
    this.height = count > 1 ? 250 : clamped(innerHeight - $("plot").getBoundingClientRect().top - scrollY - 60, 300, 560);
    return all;
  }
  /** Marks the chosen row, by its place. */
  mark() {
    const { row } = this.page.view;
    this.chart.mark(row === "" ? [] : this.places(Number(row)).map((place) => [...place, "ring"]));
  }
}

/** Maps of a metric over two axes of a grid: one, or one of each value of a third axis. */
class Maps extends View {
  get view() {
    const { view, study } = this.page, [x, y] = ["x", "y"].map((name) => study.dims.find((dim) => dim.path === view[name]) ?? study.dims[study.start[name]]);
    // an address may have anything
    const clipped = (one, most) => clamped(Math.trunc(one) || 0, 0, most);
    const at = study.dims.map((dim) => { const own = view[`at.${dim.path}`] ?? (dim.seed ? "all" : study.start.at[dim.i]); return own === "all" ? own : clipped(own, dim.size - 1); });
    const ends = (view.region ?? "").split("~").map((one, k) => clipped(one, [x, y][k % 2].size)), whole = ends.length !== 4 || ends[0] >= ends[2] || ends[1] >= ends[3];
    return { x, y, at, how: study.metric(view.metric)?.yes ? "mean" : view.how, facet: study.dims.find((dim) => dim.path === view.facet && dim !== x && dim !== y) ?? null, most: [0, 0].fill(clamped($("plot").clientWidth, 200, 1024)),
      from: whole ? [0, 0] : ends.slice(0, 2), to: whole ? [x.size, y.size] : ends.slice(2) };
  }
  form(pick) {
    const { study, page } = this, { x, y, at, facet } = this.view, dims = study.dims.filter((dim) => dim.size > 1 && !dim.seed), forget = { region: "" };
    const swap = (name) => (value) => { const other = { x: y, y: x }[name]; return { [name]: value, ...(other.path === value ? { [name === "x" ? "y" : "x"]: { x, y }[name].path } : {}), ...(facet?.path === value ? { facet: "" } : {}), ...forget }; };
    return [
      pick("metric", "metric", study.metrics.map((one) => [one.name, one.label]), page.view.metric),
      pick("x", "x", dims.map((dim) => [dim.path, dim.name]), x.path, swap("x")),
      pick("y", "y", dims.map((dim) => [dim.path, dim.name]), y.path, swap("y")),
      ...(dims.length > 2 ? [pick("side by side", "facet", [["", "none"], ...dims.filter((dim) => dim !== x && dim !== y).map((dim) => [dim.path, dim.name])], facet?.path ?? "")] : []),
      ...study.dims.filter((dim) => dim.size > 1 && ![x, y, facet].includes(dim)).map((dim) => pick(dim.name, `at.${dim.path}`, [["all", "all"], ...dim.values.map((_, i) => [i, dim.said(i)])], at[dim.i])),
      pick("of several", "how", Object.keys(reduced).map((one) => [one, one]), page.view.how),
      ...(this.side() ? [pick("gain condition", "condition", [["none", "none"], ...study.conditions.map((one) => [one.name, one.title])], page.view.condition)] : []),
    ];
  }
  /** The side whose gains the axes are, if they are, from small to large. */
  side() {
    const { x, y } = this.view, [a, b] = [x.path, y.path].sort(), side = a.split(".")[1];
    return x.rising && y.rising && a === `observer.${side}.alpha` && b === `observer.${side}.lambda` && this.study.metric(`${side}.f_plus`) ? side : null;
  }
  /** Which values of the facet are drawn, all or some of many; where each is looked at. */
  facets() {
    const { view } = this, { facet, at } = view, count = facet ? Math.min(facet.size, MOST_FACETS) : 1;
    return Array.from({ length: count }, (_, k) => (facet ? { ...view, at: at.with(facet.i, Math.round((k * (facet.size - 1)) / Math.max(count - 1, 1))) } : view));
  }
  /** From what the export computed, before any column is read. */
  first() {
    const { overview } = this.study, { view } = this, shape = [...overview.shape].reverse();
    this.draw([{ view, shown: { values: unpacked(overview.values), cells: shape, step: shape.map((one, i) => Math.ceil(view.to[i] / one)) } }]);
  }
  async update(mask, current) {
    const { study, page: { view: { metric, condition } } } = this, side = this.side(), own = metric.split(".")[0], bounds = side && condition !== "none" ? `${side}.f_plus` : null;
    const converged = `${own}.converged`, hatched = study.metric(converged) && metric !== converged;
    const [column, bound, works] = await Promise.all([metric, bounds, hatched ? converged : null].map((name) => name && study.column(name)));
    if (!current()) return "";
    const panels = this.facets().map((view) => {
      const median = bound && reduced.median(mapped(study, bound, { ...view, how: "median" }).values.filter(Number.isFinite));
      return { view, shown: mapped(study, column, view, mask), failed: works && mapped(study, works, { ...view, how: "mean" }).values, bound: median, curve: this.curve(median, view, condition) };
    });
    Object.assign(this, { column, mask });
    this.draw(panels);
    const { facet, at } = this.view, known = [...new Set(panels.map((one) => one.bound).filter((one) => one > 0).map(text))];
    return [
      facet && facet.size > panels.length ? `${panels.length} of ${facet.size} values of ${facet.name}.` : "",
      panels.some(({ failed }) => failed?.some((one) => one < 0.5)) ? `Hatched: the ${own} observer did not converge${at.includes("all") ? " in most runs" : ""}.` : "",
      known.length ? `f⁺ = ${known.join("; ")} rad/s²: the median of what is shown.` : "", this.panels.some(({ star }) => star) ? "★: the best gains." : "",
    ].filter(Boolean).join(" ");
  }
  /** Least lambda over alpha of a condition, at a bound f_plus. */
  curve(bound, { x, y }, name) {
    if (!(bound > 0)) return null;
    const { alpha, lambda, title } = this.study.conditions.find((one) => one.name === name);
    const places = (dim) => (dim.path.endsWith(".alpha") ? Array.from(unpacked(alpha), (one) => dim.place(one * bound)) : Array.from(unpacked(lambda), (one) => dim.place(one * Math.sqrt(bound))));
    return { title, x: places(x), y: places(y) };
  }
  draw(panels) {
    const { study, page } = this, { metric, log } = page.view, { facet } = this.view;
    const scale = (this.scale = scaleOf(study, metric, panels.flatMap(({ shown }) => [...shown.values]), log !== "linear")), figures = this.figures(scale, panels.length);
    this.panels = panels.map((panel, number) => {
      const { view, shown: { values, cells, step, out }, failed, curve } = panel, { x, y, from, to } = view, here = facet ? `${facet.name} = ${facet.said(view.at[facet.i])}` : "";
      const ends = [x, y].map((dim, i) => [dim.edge(from[i] - 0.5), dim.edge(to[i] - 0.5)]);
      const lines = (cell) => [`${study.metric(metric).label}: ${out?.[cell[1] * cells[0] + cell[0]] ? "left out by the filter" : text(values[cell[1] * cells[0] + cell[0]])}`,
        ...[x, y].map((dim, i) => `${dim.name}: ${dim.said(Math.min(from[i] + cell[i] * step[i], to[i] - 1))}`), here].filter(Boolean);
      const drawn = {
        size: cells, x: [ends[0][0], x.edge(from[0] + cells[0] * step[0] - 0.5)], y: [ends[1][0], y.edge(from[1] + cells[1] * step[1] - 0.5)], text: lines,
        colours: sheetOf(cells, (k) => (out?.[k] ? null : [...scale.colour(values[k]), 255])), hatched: failed?.some((one) => one < 0.5) && sheetOf(cells, (k) => (failed[k] < 0.5 && !out?.[k] ? [0, 0, 0, 255] : null)),
        move: (across, up) => {
          const cell = this.cursor?.chart === chart ? this.cursor.cell : from.map((one, i) => (one + to[i]) >> 1);
          this.cursor = { chart, cell: cell.map((one, i) => clamped(one + [across, up][i], from[i], to[i] - 1)) };
          this.mark();
          $("state").textContent = lines(this.cursor.cell.map((one, i) => Math.floor((one - from[i]) / step[i]))).join("; ");
        },
      };
      const chart = new Chart(figures[number], {
        x: { ...x.axis, ends: ends[0] }, y: { ...y.axis, ends: ends[1] }, cells: drawn, height: this.height, scale, title: here,
        // outlined, and named where it leaves the map
        lines: curve ? [["#000000", 4], ["#FFD400", 2]].map(([colour, width]) => ({ ...curve, colour, width })) : [], drawn: curve && ((plot) => this.nameCurve(chart, curve, plot)),
        zoomed: (range) => page.change({ region: range ? [0, 1].flatMap((end) => [x, y].map((dim, i) => (range[i] ? dim.index(range[i][end]) + end : [from, to][end][i]))).join("~") : "" }),
        picked: (found) => { const cell = found.place ? [x.index(found.place[0]), y.index(found.place[1])] : this.cursor?.cell; if (cell) page.take(this.row(view, cell)); },
      });
      const star = study.stars.find((one) => (!this.mask || this.mask[this.row(view, [x, y].map((dim) => one[dim.i]))]) && metric === study.first && [x, y].every((dim) => [study.start.x, study.start.y].includes(dim.i)) && study.dims.every((dim) => [x, y].includes(dim) || dim.seed || view.at[dim.i] === one[dim.i]));
      return { chart, view, star };
    });
    this.mark();
  }
  /** The name of a curve, beside it. */
  nameCurve(chart, { title, x, y }, { ctx, bbox }) {
    const isInside = ([left, top]) => left > bbox.left && left < bbox.left + 0.75 * bbox.width && top > bbox.top + 16 && top < bbox.top + bbox.height;
    const place = x.map((one, k) => chart.at(one, y[k], true)).findLast(isInside);
    if (!place) return;
    Object.assign(ctx, { font: `${12 * devicePixelRatio}px system-ui, sans-serif`, textAlign: "left", textBaseline: "bottom", lineWidth: 3 * devicePixelRatio, strokeStyle: "#000000", fillStyle: "#FFD400", lineJoin: "round" });
    ctx.strokeText(title, place[0], place[1] - 4);
    ctx.fillText(title, place[0], place[1] - 4);
  }
  row({ x, y, at }, cell) { return this.study.dims.reduce((sum, dim) => sum + dim.stride * (dim === x ? cell[0] : dim === y ? cell[1] : at[dim.i] === "all" ? 0 : at[dim.i]), 0); }
  indices(row) { return this.study.dims.map((dim) => dim.indexOf(row)); }
  /** The chosen point in all maps, strongest where it lies; the star; the keyboard's cell. */
  mark() {
    const { row } = this.page.view, at = row === "" ? null : this.indices(Number(row));
    for (const { chart, view, star } of this.panels) {
      const { x, y } = view, here = at && this.study.dims.every((dim) => dim === x || dim === y || view.at[dim.i] === "all" || view.at[dim.i] === at[dim.i]);
      const cell = this.cursor?.chart === chart && this.cursor.cell;
      const marks = [at && [at[x.i], at[y.i], here ? "ring" : "ghost"], cell && [...cell, "ring"], star && [star[x.i], star[y.i], "star"]];
      chart.mark(marks.filter(Boolean).map(([i, j, kind]) => [x.edge(i), y.edge(j), kind]));
    }
  }
  /** Whether a row is in what is shown. */
  shows() {
    const { x, y, at, facet, from, to } = this.view;
    const ends = this.study.dims.map((dim) => (dim === x ? [from[0], to[0]] : dim === y ? [from[1], to[1]] : dim === facet || at[dim.i] === "all" ? [0, dim.size] : [at[dim.i], at[dim.i] + 1]));
    return (row) => this.study.dims.every((dim, i) => dim.indexOf(row) >= ends[i][0] && dim.indexOf(row) < ends[i][1]);
  }
  /** Lines over each axis, through a row. */
  cuts(row) {
    const { study, view, page: { view: { metric } } } = this, at = this.indices(row), figures = [addFigure($("cuts")), addFigure($("cuts"))];
    return ["x", "y"].map((name, i) => {
      const dim = view[name], from = [at[view.x.i], at[view.y.i]].with(i, 0), to = [at[view.x.i] + 1, at[view.y.i] + 1].with(i, dim.size);
      const { values } = mapped(study, this.column, { ...view, at: study.dims.map((one) => (view.at[one.i] === "all" ? "all" : at[one.i])), from, to, most: [1e9, 1e9] });
      const finite = values.filter(Number.isFinite), log = this.scale.log && reduced.least(finite) > 0 && reduced.largest(finite) > 10 * reduced.least(finite);
      const lines = [{ x: [...values.keys()].map(dim.edge), y: values, colour: COLOURS[1], width: 2, sorted: true }], marks = [[dim.edge(at[dim.i]), values[at[dim.i]], "ring"]];
      return new Chart(figures[i], { x: dim.axis, y: { log }, lines, marks, height: 160, title: study.metric(metric).label, picked: ({ i: k }) => this.page.take(row + (k - at[dim.i]) * dim.stride) });
    });
  }
}

/** Points over any two axes or metrics, coloured by a third. */
class Dots extends View {
  form(pick) {
    const { view, study } = this.page, all = [...study.fields.values()].filter((one) => one.metric || one.varied).map((one) => [one.name, one.metric ? one.label : one.name]);
    return [pick("colours", "metric", all, view.metric), pick("x", "px", all, view.px, (px) => ({ px, range: "" })), pick("y", "py", all, view.py, (py) => ({ py, range: "" }))];
  }
  get range() {
    const ends = (this.page.view.range ?? "").split("~").map((one) => (one === "" ? NaN : Number(one)));
    return [0, 2].map((i) => (Number.isFinite(ends[i]) && Number.isFinite(ends[i + 1]) ? [ends[i], ends[i + 1]] : null));
  }
  async update(mask, current) {
    const { page, study } = this, { metric, px, py, log } = page.view, names = [px, py, metric], read = await Promise.all(names.map((name) => study.fields.get(name).read()));
    if (!current()) return "";
    const { rows, said } = this.rows(mask, MOST_DOTS), [x, y, shade] = read.map((one) => rows.map(one));
    const axis = (name, values) => { const field = study.fields.get(name), [low, high] = endsOf([values], true); return { ...field, unit: "", key: field.metric ? "" : name, log: log !== "linear" && !field.names && values.every((one) => !(one <= 0)) && (Boolean(field.log) || high / low > 30) }; };
    const field = study.fields.get(metric), scale = scaleOf(study, metric, shade, log !== "linear"), [figure] = this.figures(scale);
    const dots = { x, y, shade, dots: rows.length > 5000 ? 3 : 6, said: (i) => [`${field.label}: ${text(field.names?.[shade[i]] ?? shade[i])}`] };
    this.read = read;
    this.chart = new Chart(figure, {
      x: axis(px, x), y: axis(py, y), lines: [dots], range: this.range, height: this.height, scale,
      zoomed: (range) => page.change({ range: range ? range.flatMap((one) => one ?? ["", ""]).join("~") : "" }), picked: ({ i }) => page.take(rows[i]),
    });
    this.mark();
    return said;
  }
  places(row) { return [[this.read[0](row), this.read[1](row)]]; }
  shows() {
    const { range, read } = this;
    return (row) => range.every((ends, i) => !ends || (read[i](row) >= ends[0] && read[i](row) <= ends[1]));
  }
}

/** A line for each point over parallel axes; a drag along one of them adds to the filter. */
class Parallel extends View {
  form(pick) { return [pick("metric", "metric", this.study.metrics.map((one) => [one.name, one.label]), this.page.view.metric)]; }
  /** The axes: what varies, the metric, and what else tells whether a run is good. */
  fields() {
    const { study, page } = this, own = page.view.metric.split(".")[0], more = ["converged", "convergence_time", "chatter", "margin_exact"].map((one) => `${own}.${one}`);
    return [...new Set([...study.named, ...more.filter((one) => study.metric(one)), page.view.metric])].slice(-9).map((one) => study.fields.get(one));
  }
  async update(mask, current) {
    const { page, study } = this, fields = this.fields(), read = await Promise.all(fields.map((one) => one.read()));
    if (!current()) return "";
    const { rows, said } = this.rows(mask, MOST_PATHS), values = read.map((one) => rows.map(one)), log = page.view.log !== "linear";
    const axes = values.map((column, k) => {
      const [low, high] = endsOf([column]);
      return { low, high, ...along({ ends: [low, low === high ? low + 1 : high], log: log && low > 0 && high / low > 30 && !fields[k].names }) };
    });
    const last = fields.findIndex((one) => one.name === page.view.metric), scale = scaleOf(study, page.view.metric, values[last], log), [figure] = this.figures(scale), words = (k, one) => fields[k].names?.[Math.round(one)] ?? text(one);
    // one line of uPlot's for each of some colours, which leaves the window between two points
    const groups = Map.groupBy(rows.keys(), (i) => { const share = scale.share(values[last][i]); return Number.isFinite(share) ? Math.round(20 * clamped(share, 0, 1)) : -1; });
    const lines = [...groups].map(([share, members]) => {
      const x = [], y = [], line = [];
      for (const i of members) {
        const own = values.map((column, k) => axes[k].share(column[i]));
        x.push(-2, ...own.keys(), fields.length + 1, fields.length + 1, -2);
        y.push(-9e3, ...own, -9e3, -9e3, -9e3);
        for (let k = 0; k < own.length + 4; k++) line.push(i);
      }
      return { x, y, rows: line, colour: `rgb(${(share < 0 ? MISSING : scale.colours[Math.round((255 * share) / 20)]).join(",")})`, width: 1, alpha: rows.length > 400 ? 0.35 : 0.7, said: (i) => values.map((column, k) => `${fields[k].name}: ${words(k, column[line[i]])}`) };
    });
    const chart = new Chart(figure, {
      x: { names: fields.map((one) => one.name.split(".").at(-1)), turn: 25, ends: [-0.4, fields.length - 0.6] }, y: { names: [], ends: [-0.06, 1.06] }, lines, scale, height: 460,
      zoomed: (range) => {
        const k = range && Math.round((range[0]?.[0] + range[0]?.[1]) / 2 || 0);
        if (!range || !fields[k]) return page.change({ filter: "" });
        const [low, high] = (range[1] ?? [0, 1]).map((share) => Number(axes[k].value(clamped(share, 0, 1)).toPrecision(4))), { name } = fields[k];
        const others = page.view.filter.split(/\s+and\s+/).filter((one) => one && !one.startsWith(`${name} `));
        page.change({ filter: [...others, `${name} >= ${low}`, `${name} <= ${high}`].join(" and ") });
      },
      picked: ({ i, line }) => page.take(rows[line.rows?.[i] ?? i]),
      drawn: ({ ctx, bbox }) => {
        Object.assign(ctx, { globalAlpha: 1, fillStyle: getComputedStyle(document.body).color, font: `${11 * devicePixelRatio}px system-ui, sans-serif`, textAlign: "center" });
        axes.forEach(({ low, high }, k) => { for (const [value, share, side] of [[low, 0, "top"], [high, 1, "bottom"]]) { ctx.textBaseline = side; ctx.fillText(words(k, value), chart.at(k, 0, true)[0], chart.at(0, share, true)[1] + (share ? -3 : 3), bbox.width / fields.length); } });
      },
    });
    Object.assign(this, { axes, read, chart });
    this.mark();
    return said;
  }
  places(row) { return this.axes.map(({ share }, k) => [k, share(this.read[k](row))]); }
}

const KINDS = { map: ["map", Maps], points: ["points", Dots], parallel: ["parallel axes", Parallel] };

/** The page: its view, as the address has it, and what is chosen. */
class Page {
  constructor(about) {
    const study = (this.study = new Study(about)), kinds = Object.entries(KINDS).slice(about.grid ? 0 : 1);
    const [px, py] = study.named.length > 1 || about.grid ? [study.named.at(-1), study.named.at(-2)] : [study.named[0], about.first];
    this.initial = { kind: kinds[0][0], metric: about.first, px, py: py ?? about.first, how: "median", condition: "exact", log: "log", filter: "", row: "", pins: "" };
    this.view = { ...this.initial, ...address.read() };
    // an address is no more than words
    for (const name of ["metric", "px", "py"]) if (!study.fields.has(this.view[name]) || (name === "metric" && this.view.kind !== "points" && !study.metric(this.view[name]))) this.view[name] = this.initial[name];
    if (!kinds.some(([name]) => name === this.view.kind)) this.view.kind = this.initial.kind;
    if (!reduced[this.view.how]) this.view.how = "median";
    if (this.view.condition !== "none" && !about.conditions?.some((one) => one.name === this.view.condition)) this.view.condition = about.grid ? "exact" : "none";
    if (!/^\d+$/.test(this.view.row) || Number(this.view.row) >= study.rows) this.view.row = "";
    this.kinds = Object.fromEntries(kinds.map(([name, [, Kind]]) => [name, new Kind(this)]));
    this.titles = kinds.map(([name, [title]]) => [name, title]);
    this.runs = about.served ? new Runs(study, () => this.change({ pins: this.runs.pinned().join("~") }, false)) : null;
    this.update = reporting("The study's points", () => this.redraw());
  }
  get shown() { return this.kinds[this.view.kind]; }
  change(view, redraw = true) {
    Object.assign(this.view, view);
    if (this.view.kind !== "points" && !this.study.metric(this.view.metric)) this.view.metric = this.initial.metric;
    address.write(Object.fromEntries(Object.entries(this.view).filter(([name, value]) => value !== this.initial[name])));
    if (redraw) { this.form(); this.update(); }
  }
  form() {
    const { view } = this, pick = (label, id, options, chosen, act = (value) => ({ [id]: value })) => choose(label, id.replaceAll(".", "-"), options, chosen, (value) => this.change(act(value)));
    const filter = made("input", { id: "filter", value: view.filter, placeholder: "converged and margin > 1.1", autocomplete: "off", onchange: ({ target }) => this.change({ filter: target.value }) });
    $("choice").replaceChildren(pick("view", "kind", this.titles, view.kind), ...this.shown.form(pick), pick("scales", "log", [["log", "log where it fits"], ["linear", "linear"]], view.log), made("label", {}, "filter", filter));
  }
  async redraw() {
    const asked = (this.asked = Symbol("asked")), current = () => asked === this.asked, { study, view } = this;
    $("state").textContent = "reading …";
    let wrong = "";
    const mask = await study.mask(view.filter, view.metric.split(".")[0]).catch((error) => { if (!error.message.startsWith("Filter:")) throw error; wrong = error.message; return null; });
    const said = await this.shown.update(mask, current);
    if (!current()) return;
    this.mask = mask;
    const passed = mask && mask.reduce((sum, one) => sum + one, 0);
    this.said = [wrong, mask ? `${passed} of ${study.rows} points pass the filter.` : "", study.found < study.total ? `${study.found} of ${study.total} runs so far.${study.served ? " Load the page again for more." : ""}` : "", said].filter(Boolean).join(" ");
    $("state").textContent = this.said;
    const { x, y, facet } = this.shown.view ?? { x: { name: view.px }, y: { name: view.py } };
    document.body.dataset.drawn = [view.metric, x.name, y.name, facet?.name].filter(Boolean).join(" ");
    await this.table();
    if (view.row !== "") await this.tell(Number(view.row));
  }
  /** Takes a point: it is marked, told, and simulated. */
  async take(row) {
    this.change({ row: String(row) }, false);
    // the first one takes half of the window
    if ($("chosen").hidden) { $("chosen").hidden = false; await this.update(); } else { this.shown.mark(); await this.tell(row); }
    await this.simulate(row);
  }
  async tell(row) {
    const { study, view, shown } = this, { values, seed } = (this.chosen = await study.point(row)), metric = study.fields.get(view.metric), value = (await metric.read())(row);
    $("chosen").hidden = false;
    $("where").textContent = `${study.said(values)}, seed ${seed}: ${metric.label} ${text(metric.names?.[value] ?? value)}`;
    $("command").textContent = this.runs || !study.effects ? "" : "Save the point beside study.toml, and simulate it: jaxbl simulate point.toml.";
    $("cuts").replaceChildren();
    this.cuts = shown.cuts?.(row) ?? [];
  }
  async simulate(row) {
    const { study, view } = this, { values, seed } = await study.point(row), name = study.metric(view.metric) ? view.metric : study.first;
    await this.runs?.simulate(values, seed, { metric: study.metric(name), value: (await study.column(name))[row] }, row);
  }
  /** The points that are shown and pass the filter: the best ones as a table. */
  async table() {
    const { study, view, mask } = this, own = view.metric.split(".")[0], large = study.rows > 1e6;
    // of very many points other columns, too, take time to be read
    if (large && !$("tabled").open) { $("count").textContent = "Points"; $("tabled").ontoggle = () => this.table(); $("csv").onclick = () => { $("tabled").open = true; }; return; }
    const names = [...new Set([...study.axes.filter((one) => one.varied).map((one) => one.name), view.metric, ...["converged", "margin_exact"].map((one) => `${own}.${one}`).filter((one) => !large && study.metric(one))])];
    const columns = Object.fromEntries(await Promise.all(names.map(async (name) => { const field = study.fields.get(name), read = await field.read(); return [name, { field, read }]; })));
    const { rows, count } = this.shown.rows(mask, large ? 1e5 : 1e6, this.shown.shows?.()), key = columns[view.metric].read;
    $("state").textContent = this.said;
    const values = Float64Array.from(rows, key), order = Uint32Array.from(rows.keys()).sort((a, b) => (values[a] - values[b]) || (values[a] === values[a] ? -1 : 1) - (values[b] === values[b] ? -1 : 1));
    const cell = ({ field, read }, row) => { const value = read(row); return field.names ? field.names[value] : field.yes ? (value ? "yes" : "no") : value; };
    $("count").textContent = `${rows.length === 1 ? "One point" : `${rows.length} points`} shown${rows.length < count && large ? " (of many)" : ""}, by ${study.fields.get(view.metric).label}`;
    const words = (name, row) => { const one = cell(columns[name], row); return typeof one === "number" ? text(one) : one; };
    const draw = () => tableOf($("rows"), ["", ...names.map((one) => columns[one].field.label)],
      [...order.slice(0, MOST_ROWS)].map((k) => [button("take", () => this.take(rows[k])), ...names.map((name) => words(name, rows[k]))]));
    if ($("tabled").open) draw();
    $("tabled").ontoggle = draw;
    $("csv").onclick = () => saveTable("points.csv", Object.fromEntries(names.map((name) => [name, [...order].map((k) => cell(columns[name], rows[k]))])));
  }
  async start() {
    const { study, view } = this;
    showHead(study);
    $("hint").textContent = `Move over it to read values, drag to enlarge, double click for the whole. Click a point to ${this.runs ? "simulate its run" : "look at it"}. Grey: no value, as the run diverged, is not there yet, or has no such number.`;
    $("whole").onclick = () => this.change({ region: "", range: "" });
    $("picture").onclick = () => savePicture("picture.png", $("bar").parentNode);
    $("point").onclick = () => saveText("point.toml", this.runs?.newest?.row === Number(view.row) ? this.runs.newest.config : pointText(this.chosen.values, study.effects));
    $("gains").onclick = () => saveText("gains.toml", gainsText(study.gains, this.chosen.values));
    for (const name of ["point", "gains"]) $(name).hidden = !study.effects;
    addEventListener("resize", () => this.update());
    this.form();
    const first = Object.keys(address.read()).every((name) => ["row", "pins", "how", "condition"].includes(name)) && study.grid;
    if (first) { $("chosen").hidden = !study.stars.length; this.shown.first(); document.body.dataset.drawn = "overview"; }
    // that of the slice which is shown first, if it has one
    const star = study.stars?.find((one) => study.dims.every((dim) => [study.start.x, study.start.y].includes(dim.i) || one[dim.i] === study.start.at[dim.i]));
    if (view.row === "" && star && first) view.row = String(study.dims.reduce((sum, dim) => sum + dim.stride * star[dim.i], 0));
    $("chosen").hidden = view.row === "";
    await this.update();
    if (!this.runs || view.row === "") return;
    for (const row of view.pins.split("~").filter((one) => /^\d+$/.test(one) && Number(one) < study.rows && one !== view.row)) { await this.simulate(Number(row)); this.runs.pin(); }
    await this.simulate(Number(view.row));
    if (view.pins.split("~").includes(view.row)) this.runs.pin();
  }
}

globalThis.jaxblData = (about) => (globalThis.page = new Page(about)).start();
