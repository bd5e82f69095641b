"use strict";
/* Draws lines by uPlot in place of their picture, reads values off other figures, zooms them, and sorts tables. Without it, the
 * page is whole. */

/** The cell of a value between edges that rise or fall; -1 outside. */
const cellOf = (edges, value) => edges.findIndex((edge, k) => (value - edge) * (value - edges[k + 1]) <= 0);

/** What a panel has at a place, in pixels from its corner: lines of text, and of a point where it is. */
const found = (panel, at, size) => {
  const axes = [panel.x, panel.y], [x, y] = axes.map(along), here = [x.value(at[0] / size[0]), y.value(1 - at[1] / size[1])];
  const said = (values) => axes.map((axis, i) => saidOf(axis, values[i])).filter(Boolean);
  if (panel.cells) {
    const { edges, values, name } = panel.cells, [i, j] = edges.map((one, k) => cellOf(one, here[k]));
    // the point that the cell is drawn around
    const centre = () => [[x, edges[0], i], [y, edges[1], j]].map(([axis, one, k]) => axis.value((axis.share(one[k]) + axis.share(one[k + 1])) / 2));
    if (i >= 0 && j >= 0) return { text: [`${name}: ${text(values[j * (edges[0].length - 1) + i])}`, ...said(centre())] };
  }
  const place = (a, b) => [x.share(a) * size[0], (1 - y.share(b)) * size[1]];
  const near = nearestOf(panel.lines, at, 30, place, [-30, 30].map((more) => x.value((at[0] + more) / size[0])));
  if (!near) return { text: said(here) };
  const { line, i } = near, point = [line.x[i], line.y[i]];
  return { text: [line.name, ...said(point)].filter(Boolean), at: place(...point), colour: line.colour };
};

const DASHES = { "--": [6, 4], ":": [2, 3], "-.": [8, 4, 2, 4] };
const black = (colour) => (colour === "#000000" ? undefined : colour);
const joined = (words, by) => words.replaceAll("\n", by);
const unpackAxis = ({ label, names, ...axis }) => ({ ...axis, label: joined(label, " "), names: names.length ? new Map(names.map(([place, name]) => [place, joined(name, ", ")])) : undefined });
const unpackLine = (line) => {
  const x = unpacked(line.x), sorted = x.every((one, i) => !i || one >= x[i - 1]);
  return { ...line, x, y: unpacked(line.y), sorted, colour: black(line.colour), alpha: line.opacity, dash: DASHES[line.dashes] };
};
const unpack = ({ title, x, y, lines, cells, bands, spans, ...panel }) => ({
  ...panel, title: joined(title, ", "), x: unpackAxis(x), y: unpackAxis(y), lines: lines.map(unpackLine),
  cells: cells && { name: joined(cells.label, " "), edges: [unpacked(cells.x), unpacked(cells.y)], values: unpacked(cells.values) },
  shades: [...bands.map((band) => ({ ...band, x: unpacked(band.x), low: unpacked(band.low), high: unpacked(band.high) })), ...spans.map((span) => ({ ...span, colour: black(span.colour) ?? GREY }))].map((one) => ({ ...one, alpha: one.low === one.high ? 1 : one.opacity })),
});

const charts = [];

/** A panel of lines as a chart, and what the panel's lines say. */
const charted = (element, { x, y, title, lines, shades }, height) => {
  // a label that is longer than its axis stands above it
  const above = 6.4 * y.label.length > height - 38, over = above ? { title: [title, y.label].filter(Boolean).join(": "), y: { ...y, name: y.label, label: " " } } : { title, y };
  // of a line with marks the marks are dots of their own
  const dotted = lines.filter((line) => line.marker).map((line) => ({ ...line, dots: line.marker === "." ? 4 : 6 }));
  new Chart(element, { x, height, named: true, group: charts, lines: [...lines.filter((line) => line.width !== 0), ...dotted], shades, ...over });
};

/** One figure: charts of its panels, or its picture with zoom and values. */
const figure = (element) => {
  const view = element.querySelector(".view"), image = view.querySelector("img"), content = element.querySelector("script");
  const panels = JSON.parse(content.textContent).map(unpack), tools = made("div", { className: "tools" });
  const tool = (label, sign, act) => tools.append(button(sign, act, { title: label, ariaLabel: label }));
  // signals; what is written into other figures, such as names beside their curves, is in the picture alone
  const isSignal = (panel) => !panel.cells && !panel.x.log && panel.lines.length && panel.lines.every((line) => line.sorted);
  if (panels.length && panels.every(isSignal)) {
    const height = Number(image.getAttribute("height"));
    image.hidden = true;
    view.removeAttribute("tabindex");
    view.style.width = "";
    for (const [, row] of Map.groupBy(panels, (panel) => Math.round(20 * panel.place[1]))) {
      const across = made("div", { className: "row" }, ...row.map(() => made("div")));
      view.append(across);
      row.forEach((panel, k) => charted(across.children[k], panel, Math.max(130, panel.place[3] * height + 45)));
    }
    tool("whole figure", "whole", () => { for (const chart of charts) if (view.contains(chart.view)) chart.zoom(null); });
  } else pictured(element, view, image, panels, tool, tools);
  tool("save as SVG", "SVG", () => made("a", { href: image.src, download: `${element.dataset.name}.svg` }).click());
  view.after(tools);
};

/** Zoom and values of a picture, which is enlarged within its view. */
const pictured = (element, view, image, panels, tool, tools) => {
  const marker = made("div", { className: "marker", hidden: true }), values = made("div", { className: "values", hidden: true }), spoken = made("span", { className: "spoken", ariaLive: "polite" });
  let scale = 1, cursor = null;
  element.append(marker, values);
  view.style.aspectRatio = image.getAttribute("width") / image.getAttribute("height");
  image.draggable = false;
  const size = () => [view.clientWidth, view.clientHeight], shift = () => [view.scrollLeft, view.scrollTop];
  const hide = () => { marker.hidden = values.hidden = true; };
  const move = (across, down) => { view.scrollBy(across, down); hide(); };
  const zoom = (factor, at = size().map((one) => one / 2)) => {
    const next = clamped(scale * factor, 1, 20), to = shift().map((one, i) => (one + at[i]) * next / scale - at[i]);
    scale = next;
    image.style.width = scale === 1 ? "" : `${100 * scale}%`;
    view.classList.toggle("zoomed", scale > 1);
    view.scrollTo(...to);
    hide();
  };
  const show = (at) => {
    const whole = size().map((one) => one * scale), here = shift().map((one, i) => one + at[i]);
    const inside = ({ place }) => here.every((one, i) => one >= place[i] * whole[i] && one <= (place[i] + place[i + 2]) * whole[i]), panel = panels.find(inside);
    if (!panel) return hide();
    const corner = whole.map((one, i) => panel.place[i] * one), there = found(panel, here.map((one, i) => one - corner[i]), whole.map((one, i) => panel.place[i + 2] * one));
    beside(values, there.text, at, view);
    marker.hidden = !there.at;
    const [left, top] = there.at?.map((one, i) => `${one + corner[i] - shift()[i]}px`) ?? [];
    if (there.at) Object.assign(marker.style, { left, top, borderColor: there.colour });
  };
  view.addEventListener("pointermove", (event) => { if (event.buttons && scale > 1) move(-event.movementX, -event.movementY); else show(placeIn(view, event)); });
  view.addEventListener("pointerdown", (event) => { if (scale > 1) view.setPointerCapture(event.pointerId); });
  view.addEventListener("pointerleave", hide);
  view.addEventListener("dblclick", (event) => zoom(scale > 1 ? 1 / scale : 3, placeIn(view, event)));
  view.addEventListener("wheel", (event) => {
    // the page scrolls, unless the figure is meant
    if (!event.ctrlKey && scale === 1) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 300), placeIn(view, event));
  }, { passive: false });
  // by keyboard: arrows move a cross-hair over the figure, or the figure where it is zoomed
  view.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 1.5 : 1 / 1.5);
    else if (event.key === "0") zoom(1 / scale);
    else if (event.key === "Escape") { cursor = null; hide(); }
    else if (step && event.shiftKey) move(40 * step[0], 40 * step[1]);
    else if (step) {
      const most = size();
      cursor = (cursor ?? most.map((one) => one / 2)).map((one, i) => clamped(one + 8 * step[i], 0, most[i]));
      show(cursor);
      spoken.textContent = values.hidden ? "" : values.textContent;
    } else return;
    event.preventDefault();
  });
  view.addEventListener("blur", () => { cursor = null; hide(); });
  for (const [label, sign, factor] of [["zoom in", "+", 1.5], ["zoom out", "−", 1 / 1.5], ["whole figure", "whole", 0]]) tool(label, sign, () => zoom(factor));
  tools.append(spoken);
};

/** A table that sorts by the column whose head is clicked: numbers first, then words, then what is no number. */
const sortable = (table) => {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], rank = (value) => (typeof value === "string" ? 1 : Number.isNaN(value) ? 2 : 0);
  heads.forEach((head, column) => {
    if (!head.textContent.trim()) return;
    const key = ({ cells: { [column]: { dataset: { value }, textContent } } }) => (value === undefined ? textContent : Number(value));
    const sort = () => {
      const rising = head.getAttribute("aria-sort") !== "ascending", sign = rising ? 1 : -1;
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", rising ? "ascending" : "descending");
      const order = (a, b) => rank(a) - rank(b) || sign * (rank(a) === 1 ? a.localeCompare(b, "en", { numeric: true }) : a - b);
      body.append(...[...body.rows].map((row) => [key(row), row]).sort(([a], [b]) => order(a, b)).map(([, row]) => row));
    };
    head.append(made("button", { type: "button", onclick: sort }, ...head.childNodes));
  });
};

document.querySelectorAll("figure").forEach(figure);
document.querySelectorAll("table").forEach((table) => { if (table.tBodies[0].rows.length > 1) sortable(table); });
