// Vectors, colors, half floats, and messages.

export const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (v) => {
  const l = Math.hypot(...v) || 1;
  return v.map((x) => x / l);
};
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
export const toLinear = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
export const toDisplay = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
// Colors of the display as text, and back.
const byte = (x) => Math.round(255 * clamp(x, 0, 1));
export const hex = (color) => `#${color.map((x) => byte(x).toString(16).padStart(2, "0")).join("")}`;
export const unhex = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);

const LONGEST = 2048; // pixels of the longer edge of what is drawn for the window

// Pixels of a canvas that is shown in a box: at most two for each pixel of the style, in the shape of the box.
export function drawnSize(box, ratio) {
  const factor = Math.min(ratio, 2, LONGEST / Math.max(box.width, box.height, 1));
  return { width: Math.max(1, Math.round(box.width * factor)), height: Math.max(1, Math.round(box.height * factor)) };
}

export function element(tag, parent, fields = {}) {
  const node = document.createElement(tag);
  Object.assign(node, fields);
  parent.appendChild(node);
  return node;
}

// Colors that Python has exposed, made bytes, and compressed: differences, channel by channel. Where a mask comes with
// them, one bit for each entry, they are those of its entries alone; the others stay as they were.
export async function inflate(data, count, before, mask) {
  const plane = await decompressed(data);
  const entries = plane.length / 3;
  const result = mask ? before : new Uint8Array(3 * count);
  const bit = (i) => !mask || (mask.getUint8(i >> 3) >> (7 - (i & 7))) & 1;
  for (let c = 0; c < 3; c++)
    for (let i = 0, from = c * entries, value = 0; i < count; i++)
      if (bit(i)) result[3 * i + c] = value = (value + plane[from++]) & 255;
  return result;
}

// Ends a task of the page, so that frames and events come between. Unlike timers it does not wait in hidden pages.
export function pause() {
  const { port1, port2 } = new MessageChannel();
  return new Promise((resolve) => {
    port1.onmessage = () => {
      port1.close();
      resolve();
    };
    port2.postMessage(null);
  });
}

export async function decompressed(data) {
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// A message and its arrays from one string of bytes, as `messages.pack` of Python packs them.
export function unpack(data) {
  const size = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  let place = 4 + size;
  const buffers = head.lengths.map((each) => {
    const view = new DataView(data, place, each);
    place += each + ((8 - (each % 8)) % 8);
    return view;
  });
  return { content: head.content, buffers };
}

// The numbers of a buffer that has come, of a kind such as Float32Array.
export const numbers = (kind, { buffer, byteOffset, byteLength }) =>
  new kind(buffer, byteOffset, byteLength / kind.BYTES_PER_ELEMENT);

export function half(bits) {
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  return exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
}

// Whether a context can draw into textures of floats.
export function floats(gl) {
  return gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
}
