/** Where the cameras drove: lines that get coarser as one looks from farther away, so that 400,000 images stay smooth. */

import type { Columns } from "./columns";

export interface Level {
  /** Between points of this level there is at least this distance. */
  spacing: number;
  /** East, north, 0 of each point. */
  points: Float32Array;
  pass: Int32Array;
  /** Whether a line leads from the point to the next. */
  joined: Uint8Array;
  /** The bounds (left, bottom, right, top) of every `CHUNK` points: successive images are near each other. */
  bounds: Float32Array;
}

export interface Box {
  left: number;
  bottom: number;
  right: number;
  top: number;
}

const CHUNK = 128;

const SPACINGS = [0, 4, 12, 40, 160];

export class Tracks {
  readonly levels: Level[];

  constructor(cameras: Columns) {
    const rows = cameras.rows("position");
    if (!rows) {
      this.levels = [];
      return;
    }
    const full: Level = {
      spacing: 0,
      points: flat(cameras.get("position")),
      pass: cameras.get<Int32Array>("pass"),
      joined: cameras.get<Uint8Array>("joined"),
      bounds: new Float32Array(),
    };
    full.bounds = boundsOf(full.points);
    this.levels = [full];
    for (const spacing of SPACINGS.slice(1)) this.levels.push(thinned(full, spacing));
  }

  /** The coarsest level that looks the same at this many metres a pixel. */
  at(metresPerPixel: number): Level | null {
    let best: Level | null = null;
    for (const level of this.levels) if (!best || level.spacing <= 4 * metresPerPixel) best = level;
    return best;
  }

  /** The level for streets, which are wider than tracks: never the finest, where there is another. */
  streets(tracks: Level): Level {
    return tracks === this.levels[0] ? (this.levels[1] ?? tracks) : tracks;
  }
}

export function flat(position: Float32Array): Float32Array {
  const points = new Float32Array(position.length);
  for (let i = 0; i < position.length; i += 3) {
    points[i] = position[i];
    points[i + 1] = position[i + 1];
  }
  return points;
}

function thinned(full: Level, spacing: number): Level {
  const rows = full.pass.length;
  const keep: number[] = [];
  let last = -1;
  for (let i = 0; i < rows; i++) {
    const begins = i === 0 || !full.joined[i - 1];
    const away =
      last < 0 ? Infinity : Math.hypot(full.points[3 * i] - full.points[3 * last], full.points[3 * i + 1] - full.points[3 * last + 1]);
    if (begins || !full.joined[i] || away >= spacing) {
      keep.push(i);
      last = i;
    }
  }
  const level: Level = {
    spacing,
    points: new Float32Array(3 * keep.length),
    pass: new Int32Array(keep.length),
    joined: new Uint8Array(keep.length),
    bounds: new Float32Array(),
  };
  keep.forEach((row, i) => {
    level.points.set(full.points.subarray(3 * row, 3 * row + 3), 3 * i);
    level.pass[i] = full.pass[row];
    // The end of a stretch is always kept, so what follows a kept point that is no end is of the same stretch.
    level.joined[i] = full.joined[row];
  });
  level.bounds = boundsOf(level.points);
  return level;
}

function boundsOf(points: Float32Array): Float32Array {
  const rows = points.length / 3;
  const chunks = Math.ceil(rows / CHUNK);
  const bounds = new Float32Array(4 * chunks);
  for (let chunk = 0; chunk < chunks; chunk++) {
    let [left, bottom, right, top] = [Infinity, Infinity, -Infinity, -Infinity];
    // One point more: the line to the next chunk belongs to this one.
    for (let i = chunk * CHUNK; i < Math.min(rows, (chunk + 1) * CHUNK + 1); i++) {
      left = Math.min(left, points[3 * i]);
      right = Math.max(right, points[3 * i]);
      bottom = Math.min(bottom, points[3 * i + 1]);
      top = Math.max(top, points[3 * i + 1]);
    }
    bounds.set([left, bottom, right, top], 4 * chunk);
  }
  return bounds;
}

/** The part of a level that may be inside a box; the level itself where that is most of it. */
export function within(level: Level, box: Box): Level {
  const chunks = level.bounds.length / 4;
  const found: number[] = [];
  for (let chunk = 0; chunk < chunks; chunk++) {
    const [left, bottom, right, top] = level.bounds.subarray(4 * chunk, 4 * chunk + 4);
    if (left <= box.right && right >= box.left && bottom <= box.top && top >= box.bottom) found.push(chunk);
  }
  if (found.length > 0.7 * chunks) return level;
  const rows = level.pass.length;
  // Every piece takes the first point of the next chunk along, as the end of its last line.
  const pieces = found.map((chunk) => [chunk * CHUNK, Math.min(rows, (chunk + 1) * CHUNK + 1)]);
  const count = pieces.reduce((sum, [from, to]) => sum + to - from, 0);
  const part: Level = {
    spacing: level.spacing,
    points: new Float32Array(3 * count),
    pass: new Int32Array(count),
    joined: new Uint8Array(count),
    bounds: new Float32Array(),
  };
  let at = 0;
  for (const [from, to] of pieces) {
    part.points.set(level.points.subarray(3 * from, 3 * to), 3 * at);
    part.pass.set(level.pass.subarray(from, to), at);
    part.joined.set(level.joined.subarray(from, to), at);
    at += to - from;
    part.joined[at - 1] = 0;
  }
  return part;
}
