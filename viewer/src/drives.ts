/** What is drawn of the drives: the worker makes the levels, here they get colours, once each. */

import { packed, passColor } from "./colors";
import type { Columns } from "./columns";
import type { Made, Wish } from "./drives.worker";
import type { Discs, Lines } from "./meshes";
import { type Drawn, SPACINGS, streetSpacing } from "./tracks";

const TRACK_OPACITY = 130;
const IMAGE_OPACITY = 200;

export interface Colored {
  spacing: number;
  tracks: Lines;
  images: Discs;
  streets: Lines;
  corners: Discs;
}

export class Drives {
  private readonly worker: Worker | null = null;
  private readonly made = new Map<number, Drawn>();
  private readonly colored = new Map<Drawn, Colored>();
  private family = {};
  private dark = false;
  private hidden: ReadonlySet<number> = new Set();
  private turn = 0;
  /** The levels that were asked for, and how many of them are still being made. */
  private readonly asked = new Set<number>();
  private missing = 0;

  /** The columns are handed to the worker: nobody can read them afterwards. */
  constructor(cameras: Columns, private readonly onMade: () => void) {
    if (!cameras.rows("position")) return;
    this.worker = new Worker(new URL("./drives.worker.ts", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }: MessageEvent<Made>) => this.take(data);
    this.drives = { spacing: 0, points: cameras.get("position"), pass: cameras.get<Int32Array>("pass"), joined: cameras.get<Uint8Array>("joined") };
  }

  private drives: Wish["drives"];

  /** Whether levels are still being made. */
  get waiting(): boolean {
    return this.missing > 0;
  }

  /** Leave passes out; what was made with them is drawn until it is made anew. */
  hide(passes: ReadonlySet<number>): void {
    if (passes.size === this.hidden.size && [...passes].every((pass) => this.hidden.has(pass))) return;
    this.hidden = new Set(passes);
    this.turn++;
    this.asked.clear();
    this.missing = 0;
    this.family = {};
  }

  /** Make the level of a spacing, and that of its streets, where it is not made yet. */
  need(spacing: number): void {
    const levels = [...new Set([spacing, streetSpacing(spacing)])].filter((each) => !this.asked.has(each));
    if (!this.worker || !levels.length) return;
    for (const each of levels) this.asked.add(each);
    this.missing += levels.length;
    const { drives, hidden, turn } = this;
    this.drives = undefined;
    this.worker.postMessage({ drives, hidden, levels, turn } satisfies Wish, drives ? [drives.points.buffer] : []);
  }

  /** The level of a spacing, or what there is instead of it so far: a coarser one rather than a finer one. */
  at(spacing: number, dark: boolean): Colored | null {
    if (dark !== this.dark) {
      this.dark = dark;
      this.family = {};
      this.colored.clear();
    }
    const wanted = SPACINGS.indexOf(spacing);
    const there = SPACINGS.filter((each) => this.made.has(each));
    const best = there.filter((each) => SPACINGS.indexOf(each) <= wanted).pop() ?? there[0];
    const drawn = this.made.get(best);
    if (!drawn) return null;
    let colored = this.colored.get(drawn);
    if (!colored) this.colored.set(drawn, (colored = this.color(drawn)));
    return colored;
  }

  private take({ drawn, turn }: Made): void {
    if (turn !== this.turn) return;
    const before = this.made.get(drawn.spacing);
    if (before) this.colored.delete(before);
    this.made.set(drawn.spacing, drawn);
    this.missing--;
    this.onMade();
  }

  private color({ spacing, tracks, images, streets, corners }: Drawn): Colored {
    const { family } = this;
    const colors = (passes: Int32Array, opacity: number) => {
      const palette: number[] = [];
      const colors = new Uint32Array(passes.length);
      for (let i = 0; i < colors.length; i++) colors[i] = palette[passes[i]] ??= packed(passColor(passes[i], this.dark), opacity);
      return colors;
    };
    const street = (count: number) => new Uint32Array(count).fill(packed(this.dark ? [34, 42, 51] : [255, 255, 255], 255));
    const lines = ({ ends, bounds }: Drawn["tracks"], colors: Uint32Array): Lines => ({ length: colors.length, ends, colors, bounds, family });
    const discs = ({ at, bounds }: Drawn["images"], fill: Uint32Array): Discs => ({ length: fill.length, position: at, fill, line: fill, bounds, family });
    return {
      spacing,
      tracks: lines(tracks, colors(tracks.pass, TRACK_OPACITY)),
      images: discs(images, colors(images.pass, IMAGE_OPACITY)),
      streets: lines(streets, street(streets.pass.length)),
      corners: discs(corners, street(corners.pass.length)),
    };
  }
}
