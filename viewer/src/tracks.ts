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
}

const SPACINGS = [0, 10, 40, 160];

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
    };
    this.levels = [full];
    for (const spacing of SPACINGS.slice(1)) this.levels.push(thinned(full, spacing));
  }

  /** The coarsest level that looks the same at this many metres a pixel. */
  at(metresPerPixel: number): Level | null {
    let best: Level | null = null;
    for (const level of this.levels) if (!best || level.spacing <= 4 * metresPerPixel) best = level;
    return best;
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
  };
  keep.forEach((row, i) => {
    level.points.set(full.points.subarray(3 * row, 3 * row + 3), 3 * i);
    level.pass[i] = full.pass[row];
    // The end of a stretch is always kept, so what follows a kept point that is no end is of the same stretch.
    level.joined[i] = full.joined[row];
  });
  return level;
}
