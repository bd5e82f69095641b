"use strict";
/* What reports and the explorer's pages share: elements, numbers as text and from text, and where a value lies among others. */

const made = (tag, properties = {}, ...children) => {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
};
/** A button, and a line's mark in its colour. */
const button = (textContent, onclick, more = {}) => made("button", { type: "button", textContent, onclick, ...more });
const markOf = (colour, dashed) => { const mark = made("span", { className: dashed ? "mark dashed" : "mark" }); mark.style.borderTopColor = colour; return mark; };
const text = (value) => {
  if (typeof value === "string") return value;
  if (value === null || Number.isNaN(value)) return "none";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(3).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(4)));
};
/** The same with as many digits as tell values between these ends apart. */
const textBetween = (value, [low, high]) =>
  Number.isFinite(value) && high - low < 0.05 * Math.abs(value) ? String(Number(value.toPrecision(9))) : text(value);
const withUnit = (name, unit) => (unit ? `${name} (${unit})` : name);
/** Bytes, and numbers that are float32, of base64. */
const bytesIn = (base64) => Uint8Array.from(atob(base64), (one) => one.charCodeAt(0));
const unpacked = (base64) => new Float32Array(bytesIn(base64).buffer);
const clamped = (value, low, high) => Math.min(high, Math.max(low, value));

/** Shares of an axis's length as values, and back. */
const along = ({ ends, log }) => {
  const [map, back] = log ? [Math.log, Math.exp] : [Number, Number], [low, high] = ends.map(map);
  return { share: (value) => (map(value) - low) / (high - low), value: (share) => back(low + share * (high - low)) };
};

/** The largest index whose value is not beyond x. */
const before = (values, x) => {
  let low = 0, high = values.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (values[middle] <= x) low = middle; else high = middle - 1;
  }
  return low;
};
/** Of lines, { x, y, sorted } each, the sample that lies nearest to a place and less than so many pixels from it; `place` gives a
 * sample's pixels, and x of what is sorted lies between `ends`. */
const nearestOf = (lines, at, reach, place, ends) => {
  let found = null, least = reach ** 2;
  for (const line of lines) {
    const { x, y, sorted } = line, first = sorted ? before(x, ends[0]) : 0, last = sorted ? Math.min(before(x, ends[1]) + 2, x.length) : x.length;
    for (let i = first; i < last; i++) {
      const [across, down] = place(x[i], y[i]), distance = (across - at[0]) ** 2 + (down - at[1]) ** 2;
      if (distance < least) [found, least] = [{ line, i }, distance];
    }
  }
  return found;
};
/** What an axis says of a value; nothing where it has neither a name nor a word for it. */
const saidOf = ({ label, name = label, key, names, unit = "", ends }, value, shown = ends) => {
  const said = names ? names.get(Math.round(value)) ?? "" : name && textBetween(value, shown);
  return name && said ? `${name}: ${said} ${unit}`.trim() + (key ? ` [${key}]` : "") : said;
};
/** What arrow keys ask for: across and down. */
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
/** The place of a pointer in an element. */
const placeIn = (element, { clientX, clientY }) => { const { left, top } = element.getBoundingClientRect(); return [clientX - left, clientY - top]; };
/** Puts a box of lines beside a place in a view, inside of it; none hides it. */
const beside = (box, lines, [x, y], view) => {
  box.hidden = !lines.length;
  box.textContent = lines.join("\n");
  const right = x + 14 + box.offsetWidth > view.clientWidth;
  box.style.left = `${Math.max(0, right ? x - 14 - box.offsetWidth : x + 14)}px`;
  box.style.top = `${Math.max(0, Math.min(y + 14, view.clientHeight - box.offsetHeight))}px`;
};
