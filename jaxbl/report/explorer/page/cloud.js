"use strict";
/* The points of a study without a map: any axis or metric over any other, coloured by a third. */

const MOST_DOTS = 40000;

globalThis.jaxblData = async (about) => {
  head(about);
  const columns = new Columns(about, 12, (name, share) => { $("state").textContent = `reading ${name}: ${Math.floor(100 * share)} %`; });
  const axes = [...about.axes, { path: "seed", unit: "", words: null }];
  // words are kept as their numbers
  const known = Object.fromEntries([
    ...axes.map(({ path, unit, words, log }) => [path, { label: path, unit, names: words, spread: log, Kind: Float64Array }]),
    ...about.metrics.map((one) => [one.name, { label: one.label, unit: "", Kind: Float32Array }]),
  ]);
  const metric = (name) => about.metrics.find((one) => one.name === name);
  const study = { named: about.axes.map((one) => one.path), metrics: about.metrics, metric };
  const runs = about.served ? new Runs(study) : null;
  const [y, x] = about.axes.length > 1 ? about.axes.slice(-2).map((one) => one.path) : [about.first, about.axes[0].path];
  const view = { x, y, shade: about.first, log: true };
  const value = (path, number) => known[path].names?.[number] ?? number;
  let plot = null, chosen = null, data = {}, said = "";

  const form = () => {
    const all = Object.entries(known).map(([name, { label, unit }]) => [name, withUnit(label, unit)]);
    const pick = (label, id, options, now, act) => choose(label, id, options, now, (given) => { act(given); form(); redraw(); });
    $("choice").replaceChildren(
      pick("colours", "metric", all, view.shade, (given) => { view.shade = given; }),
      pick("x", "x", all, view.x, (given) => { view.x = given; }),
      pick("y", "y", all, view.y, (given) => { view.y = given; }),
      pick("axes and colours", "log", [["true", "logarithmic where it fits"], ["false", "linear"]], view.log, (given) => { view.log = given === "true"; }),
    );
  };

  const update = async () => {
    const asked = (update.asked = Symbol("asked"));
    $("state").textContent = "reading …";
    const names = [...new Set([view.x, view.y, view.shade])], read = await Promise.all(names.map((name) => columns.get(name, known[name].Kind)));
    if (asked !== update.asked) return;
    data = Object.fromEntries(names.map((name, i) => [name, read[i]]));
    // the first points of a design cover its ranges evenly
    const every = about.sampled ? 1 : Math.ceil(about.rows / MOST_DOTS), rows = [];
    for (let i = 0; i < about.rows && rows.length < MOST_DOTS; i += every) rows.push(i);
    const axis = (name) => {
      const values = rows.map((i) => data[name][i]), { low, high } = Scale.of(values, {});
      const positive = values.every((one) => !(one <= 0));
      return { ...known[name], log: view.log && positive && (known[name].spread || high / low > 30) && !known[name].names };
    };
    const shade = rows.map((i) => data[view.shade][i]), { label, unit, names: words } = known[view.shade];
    const shaded = (i) => `${withUnit(label, unit)}: ${text(value(view.shade, shade[i]))}`;
    const range = plot && plot.of === `${view.x} ${view.y}` ? plot.range : null;
    plot = new Plot($("plot"), { x: axis(view.x), y: axis(view.y), height: 560, picked: ({ i }) => take(rows[i]), caption: `${withUnit(label, unit)} by colour` });
    Object.assign(plot, { of: `${view.x} ${view.y}`, range });
    plot.scale = Scale.of(shade, { colours: coloursOf(about), label, unit, names: words, ...(metric(view.shade)?.yes ? { low: 0, high: 1 } : {}), ...(view.log ? {} : { log: false }) });
    plot.set([{ name: "", x: rows.map((i) => data[view.x][i]), y: rows.map((i) => data[view.y][i]), shade, dots: rows.length > 5000 ? 3 : 6, said: (i) => [shaded(i)] }]);
    const some = rows.length < about.rows ? `${rows.length} of ${about.rows} points are drawn. ` : "";
    said = $("state").textContent = some + (about.found < about.total ? `${about.found} of ${about.total} runs so far.${about.served ? " Load the page again for more." : ""}` : "");
    document.body.dataset.drawn = `${view.shade} ${view.x} ${view.y}`;
  };
  const redraw = reporting("The study's points", update);

  /** A point by its row: values by path, and its seed. */
  const take = async (row) => {
    const read = await Promise.all(axes.map(({ path }) => columns.get(path, Float64Array)));
    const found = Object.fromEntries(axes.map(({ path }, i) => [path, value(path, read[i][row])])), { seed, ...values } = found;
    chosen = values;
    $("chosen").hidden = false;
    $("where").textContent = `${pointWords(about.axes, values)}, seed ${seed}`;
    $("command").textContent = runs ? "" : "Save the point beside study.toml, and simulate it: jaxbl simulate point.toml.";
    plot.cursor = [data[view.x][row], data[view.y][row]];
    plot.draw();
    const name = metric(view.shade) ? view.shade : about.first;
    $("state").textContent = said;
    runs?.simulate(values, seed, { metric: metric(name), value: (await columns.get(name))[row] });
  };

  $("hint").textContent = `Move over the points to read values. Drag to enlarge a region, double click for the whole. Click a point to ${runs ? "simulate its run" : "save it as a config"}. Grey: no value, as the run diverged.`;
  $("point").addEventListener("click", () => saveText("point.toml", runs ? runs.config() : pointText(chosen, about.effects)));
  $("gains").addEventListener("click", () => saveText("gains.toml", gainsText(about.gains, chosen)));
  addEventListener("resize", () => { plot?.draw(); for (const one of runs?.plots ?? []) one.draw(); });
  form();
  await redraw();
};
