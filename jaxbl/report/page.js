"use strict";
/* Draws lines by uPlot in place of their picture, reads values off other figures, zooms them, and sorts tables. Without it, the
 * page is whole. */

/** An axis of a panel: values at shares of its length, and back. */
class Axis {
  constructor(of) {
    Object.assign(this, of);
    const map = this.log ? Math.log : (value) => value;
    [this.low, this.high] = this.ends.map(map);
    this.map = map;
  }
  share(value) { return (this.map(value) - this.low) / (this.high - this.low); }
  value(share) {
    const mapped = this.low + share * (this.high - this.low);
    return this.log ? Math.exp(mapped) : mapped;
  }
  text(value) {
    if (!this.names?.length) return text(value);
    const near = this.names.reduce((a, b) => (Math.abs(b[0] - value) < Math.abs(a[0] - value) ? b : a));
    return Math.abs(near[0] - value) <= 0.5 ? near[1] : "";
  }
  /** A line of text for a value; none where it has neither a name nor a label. */
  line(value) {
    const text = this.text(value);
    return this.label && text ? [`${this.label}: ${text}${this.key ? ` [${this.key}]` : ""}`] : this.names?.length && text ? [text] : [];
  }
}

/** What a panel has at a place: lines of text (of a map, those of the cell), and where the nearest point is (shares of the panel). */
const found = (panel, at, size) => {
  const { x, y } = panel, here = [x.value(at[0]), y.value(1 - at[1])];
  const place = [...x.line(here[0]), ...y.line(here[1])];
  const bar = panel.bars.find(([left, bottom, width, height]) =>
    (here[1] - bottom) * (here[1] - bottom - height) <= 0 && (here[0] - left) * (here[0] - left - width) <= 0);
  if (bar) {
    const lies = y.names, ends = [bar[0] + (lies ? bar[2] : bar[2] / 2), bar[1] + (lies ? bar[3] / 2 : bar[3])];
    return { text: lies ? [...y.line(ends[1]), ...x.line(ends[0])] : [...x.line(ends[0]), ...y.line(ends[1])] };
  }
  if (panel.cells) {
    const { edges, values, name } = panel.cells;
    const index = edges.map((one, i) => {
      const rising = one[0] <= one[one.length - 1], inside = rising ? one : Float32Array.from(one).reverse();
      const found = Math.min(before(inside, here[i]), one.length - 2);
      return here[i] < inside[0] || here[i] > inside[inside.length - 1] ? -1 : rising ? found : one.length - 2 - found;
    });
    if (Math.min(...index) >= 0) {
      const value = values[index[1] * (edges[0].length - 1) + index[0]];
      // the point that the cell is drawn around
      const centre = [x, y].flatMap((axis, i) =>
        axis.line(axis.value((axis.share(edges[i][index[i]]) + axis.share(edges[i][index[i] + 1])) / 2)));
      return { text: [`${name}: ${text(value)}`, ...centre] };
    }
  }
  let best = null, least = 30 * 30;
  for (const line of panel.lines) {
    let first = 0, last = line.x.length;
    if (line.sorted && !x.log && last > 400) {
      const reach = (x.high - x.low) * 30 / size[0];
      first = before(line.x, here[0] - reach);
      last = Math.min(before(line.x, here[0] + reach) + 2, last);
    }
    for (let i = first; i < last; i++) {
      const shares = [x.share(line.x[i]), 1 - y.share(line.y[i])];
      const distance = ((shares[0] - at[0]) * size[0]) ** 2 + ((shares[1] - at[1]) * size[1]) ** 2;
      if (distance < least) { least = distance; best = { line, i, shares }; }
    }
  }
  if (!best) return { text: place };
  const head = best.line.name ? [best.line.name] : [];
  const said = [...head, ...x.line(best.line.x[best.i]), ...y.line(best.line.y[best.i])];
  return { text: said, at: best.shares, colour: best.line.colour };
};

const unpack = (panels) => panels.map((panel) => ({
  ...panel,
  x: new Axis(panel.x),
  y: new Axis(panel.y),
  lines: panel.lines.map((line) => ({ ...line, x: unpacked(line.x), y: unpacked(line.y) })),
  cells: panel.cells && {
    name: panel.cells.name, edges: [unpacked(panel.cells.x), unpacked(panel.cells.y)], values: unpacked(panel.cells.values),
  },
}));

const DASHES = { "--": [6, 4], ":": [2, 3], "-.": [8, 4, 2, 4] };
const charts = [];

/** A panel of lines as a chart, and what the panel's lines say. */
const charted = (element, panel, height) => {
  const axis = ({ names, ends, ...of }) => ({ ...of, ends, names: names && new Map(names) });
  const black = (colour) => (colour === "#000000" ? undefined : colour);
  const chart = new Chart(element, { x: axis(panel.x), y: axis(panel.y), height, title: panel.title, named: true, zoomed: (range) => follow(chart, range) });
  const lines = panel.lines.map((line) => ({ ...line, x: unpacked(line.x), y: unpacked(line.y), colour: black(line.colour), alpha: line.opacity, dash: DASHES[line.dashes] }));
  // of a line with marks the marks are dots of their own
  const dotted = lines.filter((line) => line.marker).map((line) => ({ ...line, dots: line.marker === "." ? 4 : 6 }));
  const bands = panel.bands.map(({ x, low, high, opacity, ...band }) => ({ ...band, x: unpacked(x), low: unpacked(low), high: unpacked(high), alpha: opacity }));
  chart.set([...lines.filter((line) => line.width !== 0), ...dotted], [...bands, ...panel.spans.map(({ opacity, dashes, colour, ...span }) => ({ ...span, colour: black(colour) ?? GREY, alpha: opacity }))]);
  charts.push(chart);
};
/** Charts over the same quantity are enlarged together. */
const follow = (from, range) => {
  for (const chart of charts) {
    if (chart !== from && !(chart.x.label && chart.x.label === from.x.label && chart.x.log === from.x.log)) continue;
    if (chart !== from) chart.range = range && [range[0], null];
    chart.build();
  }
};

/** One figure: charts of its panels, or its picture with zoom and values. */
const figure = (element) => {
  const view = element.querySelector(".view"), image = view.querySelector("img"), content = element.querySelector("script");
  const panels = JSON.parse(content.textContent), tools = made("div", { className: "tools" });
  const tool = (label, textContent, act) => {
    const button = made("button", { type: "button", textContent, title: label, ariaLabel: label });
    button.addEventListener("click", act);
    tools.append(button);
  };
  // signals; what is written into other figures, such as names beside their curves, is in the picture alone
  const isSignal = (panel) => panel.bands && !panel.cells && !panel.bars.length && !panel.x.log && panel.lines.length && panel.lines.every((line) => line.sorted);
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
  } else pictured(view, image, unpack(panels), tool, tools);
  tool("save as SVG", "SVG", () => made("a", { href: image.src, download: `${element.dataset.name}.svg` }).click());
  view.after(tools);
};

/** Zoom and values of a picture. */
const pictured = (view, image, panels, tool, tools) => {
  const marker = made("div", { className: "marker", hidden: true }), values = made("div", { className: "values", hidden: true });
  view.append(marker, values);
  let scale = 1, shift = [0, 0], from = null, cursor = null;
  const hide = () => { marker.hidden = values.hidden = true; };
  const draw = () => {
    const { clientWidth: width, clientHeight: height } = view;
    shift = [Math.min(0, Math.max(shift[0], width * (1 - scale))), Math.min(0, Math.max(shift[1], height * (1 - scale)))];
    image.style.transform = scale === 1 ? "" : `translate(${shift[0]}px, ${shift[1]}px) scale(${scale})`;
    view.classList.toggle("zoomed", scale > 1);
    hide();
  };
  const zoom = (factor, at = [view.clientWidth / 2, view.clientHeight / 2]) => {
    const next = Math.min(20, Math.max(1, scale * factor));
    shift = shift.map((one, i) => at[i] - (at[i] - one) * next / scale);
    scale = next;
    draw();
  };
  const show = (at) => {
    const width = view.clientWidth * scale, height = view.clientHeight * scale;
    const share = [(at[0] - shift[0]) / width, (at[1] - shift[1]) / height];
    const panel = panels.find(({ place: [left, top, wide, high] }) => share[0] >= left && share[0] <= left + wide && share[1] >= top && share[1] <= top + high);
    if (!panel) return hide();
    const [left, top, wide, high] = panel.place, here = found(panel, [(share[0] - left) / wide, (share[1] - top) / high], [wide * width, high * height]);
    beside(values, here.text, at, view);
    marker.hidden = !here.at;
    if (here.at) Object.assign(marker.style, { left: `${(left + here.at[0] * wide) * width + shift[0]}px`, top: `${(top + here.at[1] * high) * height + shift[1]}px`, borderColor: here.colour });
  };
  const place = (event) => {
    const box = view.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  view.addEventListener("pointermove", (event) => {
    if (!from) return show(place(event));
    const at = place(event);
    shift = shift.map((one, i) => one + at[i] - from[i]);
    from = at;
    draw();
  });
  view.addEventListener("pointerdown", (event) => { if (scale > 1) { from = place(event); view.setPointerCapture(event.pointerId); } });
  for (const name of ["pointerup", "pointercancel"]) view.addEventListener(name, () => { from = null; });
  view.addEventListener("pointerleave", hide);
  view.addEventListener("dblclick", (event) => zoom(scale > 1 ? 1 / scale : 3, place(event)));
  view.addEventListener("wheel", (event) => {
    // the page scrolls, unless the figure is meant
    if (!event.ctrlKey && scale === 1) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 300), place(event));
  }, { passive: false });
  const spoken = made("span", { className: "spoken", ariaLive: "polite" });
  // by keyboard: arrows move a cross-hair over the figure, or the figure where it is zoomed
  view.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 1.5 : 1 / 1.5);
    else if (event.key === "0") zoom(1 / scale);
    else if (event.key === "Escape") { cursor = null; hide(); }
    else if (step && event.shiftKey) { shift = shift.map((one, i) => one - 40 * step[i]); draw(); }
    else if (step) {
      const size = [view.clientWidth, view.clientHeight];
      cursor = (cursor ?? size.map((one) => one / 2)).map((one, i) => Math.min(size[i], Math.max(0, one + 8 * step[i])));
      show(cursor);
      spoken.textContent = values.hidden ? "" : values.textContent;
    } else return;
    event.preventDefault();
  });
  view.addEventListener("blur", () => { cursor = null; hide(); });
  for (const [label, sign, act] of [["zoom in", "+", () => zoom(1.5)], ["zoom out", "−", () => zoom(1 / 1.5)], ["whole figure", "whole", () => zoom(1 / scale)]]) tool(label, sign, act);
  tools.append(spoken);
};

/** A table that sorts by the column whose head is clicked. */
const sortable = (table) => {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = made("button", { type: "button" }, ...head.childNodes);
    if (!button.textContent.trim()) return;
    head.append(button);
    button.addEventListener("click", () => {
      const rising = head.getAttribute("aria-sort") !== "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", rising ? "ascending" : "descending");
      const key = (row) => {
        const cell = row.cells[column];
        return "value" in cell.dataset ? Number(cell.dataset.value) : cell.textContent;
      };
      const rank = (value) => (Number.isNaN(value) ? 2 : typeof value === "number" ? 0 : 1);
      const rows = [...body.rows].map((row) => [key(row), row]);
      rows.sort(([a], [b]) => rank(a) - rank(b) ||
        (rising ? 1 : -1) * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true })));
      body.append(...rows.map(([, row]) => row));
    });
  });
};

document.querySelectorAll("figure").forEach(figure);
document.querySelectorAll("table").forEach((table) => { if (table.tBodies[0].rows.length > 1) sortable(table); });
addEventListener("resize", () => { for (const chart of charts) chart.draw(); });
