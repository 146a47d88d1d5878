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

/**
 * Which lines of a level are to be drawn: not those of hidden passes, and of those that would cover each other, from one
 * cell of a grid to the same other cell, only the first. `cellM` of 0 keeps them all.
 */
export function distinct(level: Level, hidden: ReadonlySet<number>, cellM: number): Uint8Array {
  const { points, pass, joined } = level;
  const rows = pass.length;
  const drawn = new Uint8Array(rows);
  const seen = new Pairs(cellM > 0 ? rows : 0);
  const cellOf = (row: number): number =>
    (Math.imul(Math.round(points[3 * row] / cellM), 0x9e3779b1) ^ Math.imul(Math.round(points[3 * row + 1] / cellM), 0x85ebca77)) >>> 0;
  for (let row = 0; row + 1 < rows; row++) {
    if (!joined[row] || (hidden.size && hidden.has(pass[row]))) continue;
    if (cellM > 0) {
      // For a line to be lost by chance both its ends must share their number with the ends of another one.
      const from = cellOf(row);
      const to = cellOf(row + 1);
      if (!seen.add(Math.min(from, to), Math.max(from, to))) continue;
    }
    drawn[row] = 1;
  }
  return drawn;
}

/** A set of pairs of 32-bit numbers; a Set of anything takes ten times as long, while somebody zooms. */
class Pairs {
  private readonly mask: number;
  private readonly first: Uint32Array;
  private readonly second: Uint32Array;
  private readonly taken: Uint8Array;

  constructor(most: number) {
    const places = 2 ** Math.ceil(Math.log2(2 * most + 2));
    this.mask = places - 1;
    this.first = new Uint32Array(places);
    this.second = new Uint32Array(places);
    this.taken = new Uint8Array(places);
  }

  /** Whether the pair is new. */
  add(first: number, second: number): boolean {
    const mixed = Math.imul(first ^ Math.imul(second, 0xc2b2ae35), 0x27d4eb2f);
    let at = (mixed ^ (mixed >>> 15)) & this.mask;
    for (; this.taken[at]; at = (at + 1) & this.mask) if (this.first[at] === first && this.second[at] === second) return false;
    this.taken[at] = 1;
    this.first[at] = first;
    this.second[at] = second;
    return true;
  }
}
