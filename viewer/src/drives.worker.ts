/** Makes the levels of the tracks while the page answers: the level that is looked at first, then all others. */

import { buffersOf, drawnOf, type Drawn, type Level, SPACINGS, thinned } from "./tracks";

/** What the page says: where the cameras were, once, and which passes nobody wants to see. */
export interface Wish {
  drives?: Level;
  hidden: ReadonlySet<number>;
  /** Of the levels that are needed first. */
  first: number[];
  turn: number;
}

/** What the page hears, of every level. */
export interface Made {
  drawn: Drawn;
  turn: number;
}

const levels = new Map<number, Level>();
let wish: Wish | null = null;

onmessage = ({ data }: MessageEvent<Wish>) => {
  if (data.drives) levels.set(0, data.drives);
  const idle = wish === null;
  wish = data;
  if (idle) void work();
};

async function work(): Promise<void> {
  while (wish) {
    const { hidden, first, turn } = wish;
    for (const spacing of new Set([...first, ...SPACINGS])) {
      const level = levels.get(spacing) ?? thinned(levels.get(0)!, spacing);
      levels.set(spacing, level);
      const drawn = drawnOf(level, hidden);
      postMessage({ drawn, turn } satisfies Made, { transfer: buffersOf(drawn) });
      await new Promise((resolve) => setTimeout(resolve)); // To hear whether something else is wished for by now.
      if (wish.turn !== turn) break;
    }
    if (wish.turn === turn) wish = null;
  }
}
