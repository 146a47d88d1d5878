/** Shapes in parts that lie near each other: the GPU is handed those that are in view, a few in every frame, each once. */

/** As many shapes are in each part but the last. */
export const PART = 512;

export interface Box {
  left: number;
  bottom: number;
  right: number;
  top: number;
}

/**
 * In which order points follow those that are near them: by the cells of a grid whose numbers of column and row are
 * interleaved bit by bit (Morton, "A computer oriented geodetic data base", 1966).
 */
export function nearby(east: Float32Array, north: Float32Array): Uint32Array {
  const { left, bottom, right, top } = around(east, north);
  const scale = 0xffff / Math.max(right - left, top - bottom, 1e-9);
  const codes = new Uint32Array(east.length);
  for (let i = 0; i < codes.length; i++) {
    codes[i] = spread((east[i] - left) * scale) | (spread((north[i] - bottom) * scale) << 1);
  }
  return sorted(codes);
}

/** The 16 bits of a whole number, with a gap after each. */
function spread(value: number): number {
  let bits = Math.floor(value) & 0xffff;
  bits = (bits | (bits << 8)) & 0x00ff00ff;
  bits = (bits | (bits << 4)) & 0x0f0f0f0f;
  bits = (bits | (bits << 2)) & 0x33333333;
  return (bits | (bits << 1)) & 0x55555555;
}

/** The rows of some numbers from the smallest to the largest, equal ones in their order: counted digit by digit. */
function sorted(codes: Uint32Array): Uint32Array {
  let rows = new Uint32Array(codes.length);
  for (let row = 0; row < rows.length; row++) rows[row] = row;
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(0x10001);
    for (const code of codes) starts[((code >>> shift) & 0xffff) + 1]++;
    for (let digit = 0; digit < 0x10000; digit++) starts[digit + 1] += starts[digit];
    const next = new Uint32Array(rows.length);
    for (const row of rows) next[starts[(codes[row] >>> shift) & 0xffff]++] = row;
    rows = next;
  }
  return rows;
}

function around(east: Float32Array, north: Float32Array): Box {
  const box = { left: Infinity, bottom: Infinity, right: -Infinity, top: -Infinity };
  for (let i = 0; i < east.length; i++) {
    box.left = Math.min(box.left, east[i]);
    box.right = Math.max(box.right, east[i]);
    box.bottom = Math.min(box.bottom, north[i]);
    box.top = Math.max(box.top, north[i]);
  }
  return box;
}

/** The bounds (left, bottom, right, top) of every part of some shapes, each of which has as many points one after the other. */
export function boundsOfParts(points: Float32Array, pointsOfShape: number): Float32Array {
  const step = 2 * pointsOfShape * PART;
  const bounds = new Float32Array(4 * Math.ceil(points.length / step));
  for (let part = 0; 4 * part < bounds.length; part++) {
    let [left, bottom, right, top] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = part * step; i < Math.min(points.length, (part + 1) * step); i += 2) {
      left = Math.min(left, points[i]);
      right = Math.max(right, points[i]);
      bottom = Math.min(bottom, points[i + 1]);
      top = Math.max(top, points[i + 1]);
    }
    bounds.set([left, bottom, right, top], 4 * part);
  }
  return bounds;
}

/** Which of `count` parts may be inside a box: all, where nothing is known about where they are. */
export function partsWithin(count: number, bounds: Float32Array | undefined, box: Box): number[] {
  const found: number[] = [];
  for (let part = 0; part < count; part++) {
    if (bounds) {
      const at = 4 * part;
      if (bounds[at] > box.right || bounds[at + 2] < box.left || bounds[at + 1] > box.top || bounds[at + 3] < box.bottom) continue;
    }
    found.push(part);
  }
  return found;
}
