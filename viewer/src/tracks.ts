/**
 * Where the cameras drove: lines that get coarser as one looks from farther away, so that 400,000 images stay smooth.
 *
 * All of it is made in a worker (drives.worker.ts), each level once and in one piece; what is drawn of it in a frame is
 * the business of parts.ts and meshes.ts.
 */

import { boundsOfParts, nearby } from "./parts";

/** Images one after the other, as they were driven or fewer of them. */
export interface Level {
  /** Between points of this level there is at least this distance. */
  spacing: number;
  /** East, north, 0 of each point. */
  points: Float32Array;
  pass: Int32Array;
  /** Whether a line leads from the point to the next. */
  joined: Uint8Array;
}

/** Lines, those that are near each other one after the other. */
export interface Lines {
  /** East and north of one end, then of the other one. */
  ends: Float32Array;
  pass: Int32Array;
  bounds: Float32Array;
}

/** Points, those that are near each other one after the other. */
export interface Points {
  /** East and north. */
  at: Float32Array;
  pass: Int32Array;
  bounds: Float32Array;
}

/** What is drawn of a level. */
export interface Drawn {
  spacing: number;
  tracks: Lines;
  /** Wide, pale lines beneath the tracks. The finest level has none: streets are wider than tracks. */
  streets: Lines;
  /** Round ends of streets. */
  corners: Points;
  /** Of the finest level only. */
  images: Points;
}

export const STREET_M = 9;

/** Streets narrower than that have no round ends, which nobody would see. */
export const ROUND_FROM_PX = 4;

/** Lines that follow each other are one where that moves them by no more than this part of a pixel. */
const STRAIGHT_PX = 0.25;

/** No more lines become one, so that making a level takes a time in proportion to it. */
const MOST_IN_ONE = 32;

/** The coarsest first, 0 for all images. */
export const SPACINGS = [160, 40, 12, 4, 0];

/** A level is fine enough where its points are at most this many pixels apart. */
const APART_PX = 4;

/** The spacing of the coarsest level that looks the same at this many metres a pixel. */
export function spacingAt(metresPerPixel: number): number {
  return SPACINGS.find((spacing) => spacing <= APART_PX * metresPerPixel) ?? 0;
}

/** The spacing of the level for streets: never the finest. */
export function streetSpacing(spacing: number): number {
  return spacing || SPACINGS[SPACINGS.length - 2];
}

/** Images in the order in which they were driven, with fewer points where they are closer than the spacing. */
export function thinned(full: Level, spacing: number): Level {
  if (spacing === 0) return full;
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
  };
  keep.forEach((row, i) => {
    level.points.set(full.points.subarray(3 * row, 3 * row + 3), 3 * i);
    level.pass[i] = full.pass[row];
    // The end of a stretch is always kept, so what follows a kept point that is no end is of the same stretch.
    level.joined[i] = full.joined[row];
  });
  return level;
}

/** What is drawn of a level without the hidden passes. */
export function drawnOf(level: Level, hidden: ReadonlySet<number>): Drawn {
  const { spacing } = level;
  // A pixel is never smaller where the level is drawn.
  const tolerance = (STRAIGHT_PX * spacing) / APART_PX;
  const tracks = straight(level, distinct(level, hidden, spacing / 2), tolerance);
  const finest = spacing === 0;
  const streets = finest ? [] : straight(level, distinct(level, hidden, Math.max(spacing, STREET_M) / 2), tolerance);
  // Coarser levels are only seen from too far away for round ends.
  const round = spacing <= (APART_PX * STREET_M) / ROUND_FROM_PX;
  const images: number[] = [];
  if (finest) for (let row = 0; row < level.pass.length; row++) if (!hidden.has(level.pass[row])) images.push(row);
  return {
    spacing,
    tracks: lines(level, tracks),
    streets: lines(level, streets),
    corners: points(level, round ? corners(streets) : []),
    images: points(level, images),
  };
}

/** The typed arrays of what is drawn, to be handed from a worker to the page without a copy. */
export function buffersOf(drawn: Drawn): ArrayBuffer[] {
  return [drawn.tracks, drawn.streets, drawn.corners, drawn.images].flatMap((each) =>
    Object.values(each).map((array: Float32Array | Int32Array) => array.buffer as ArrayBuffer),
  );
}

/** The rows of both ends of every line, one line after the other. */
type Ends = number[];

/** The lines that are drawn, with those in one that follow each other and leave out no point by more than the tolerance. */
export function straight({ points }: Level, drawn: Uint8Array, tolerance: number): Ends {
  const ends: Ends = [];
  for (let row = 0; row < drawn.length; row++) {
    if (!drawn[row]) continue;
    const from = row;
    while (tolerance > 0 && drawn[row + 1] && row - from < MOST_IN_ONE && near(points, from, row + 2, tolerance)) row++;
    ends.push(from, row + 1);
  }
  return ends;
}

/** Whether the points between two rows are no farther than that from the line between the two, and one after the other along it. */
function near(points: Float32Array, from: number, to: number, tolerance: number): boolean {
  const [x, y] = [points[3 * from], points[3 * from + 1]];
  const [east, north] = [points[3 * to] - x, points[3 * to + 1] - y];
  const length = Math.hypot(east, north);
  let before = 0;
  for (let row = from + 1; row <= to; row++) {
    const [right, up] = [points[3 * row] - x, points[3 * row + 1] - y];
    const along = right * east + up * north;
    if (along < before || Math.abs(right * north - up * east) > tolerance * length) return false;
    before = along;
  }
  return true;
}

/** Both ends of all lines, those between two lines once. */
function corners(ends: Ends): number[] {
  return ends.filter((row, i) => i % 2 || row !== ends[i - 1]);
}

function lines({ points, pass }: Level, rows: Ends): Lines {
  const count = rows.length / 2;
  const east = new Float32Array(count);
  const north = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const [from, to] = [3 * rows[2 * i], 3 * rows[2 * i + 1]];
    east[i] = (points[from] + points[to]) / 2;
    north[i] = (points[from + 1] + points[to + 1]) / 2;
  }
  const ends = new Float32Array(4 * count);
  const passes = new Int32Array(count);
  nearby(east, north).forEach((at, i) => {
    const [from, to] = [3 * rows[2 * at], 3 * rows[2 * at + 1]];
    ends[4 * i] = points[from];
    ends[4 * i + 1] = points[from + 1];
    ends[4 * i + 2] = points[to];
    ends[4 * i + 3] = points[to + 1];
    passes[i] = pass[rows[2 * at]];
  });
  return { ends, pass: passes, bounds: boundsOfParts(ends, 2) };
}

function points(level: Level, rows: number[]): Points {
  const east = new Float32Array(rows.length);
  const north = new Float32Array(rows.length);
  rows.forEach((row, i) => {
    east[i] = level.points[3 * row];
    north[i] = level.points[3 * row + 1];
  });
  const at = new Float32Array(2 * rows.length);
  const pass = new Int32Array(rows.length);
  nearby(east, north).forEach((from, i) => {
    at[2 * i] = east[from];
    at[2 * i + 1] = north[from];
    pass[i] = level.pass[rows[from]];
  });
  return { at, pass, bounds: boundsOfParts(at, 1) };
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
