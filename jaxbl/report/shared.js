"use strict";
/* What reports and the explorer's pages share: numbers as text, numbers from text, and where a value lies among others. */

const text = (value) => {
  if (typeof value === "string") return value;
  if (value === null || Number.isNaN(value)) return "none";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(3).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(4)));
};
/** Numbers that are float32 in base64. */
const unpacked = (bytes) => new Float32Array(Uint8Array.from(atob(bytes), (one) => one.charCodeAt(0)).buffer);

/** The largest index whose value is not beyond x. */
const before = (values, x) => {
  let low = 0, high = values.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (values[middle] <= x) low = middle; else high = middle - 1;
  }
  return low;
};
