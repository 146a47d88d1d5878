/** Makes the levels of the tracks that somebody looks at, while the page answers. */

import { buffersOf, drawnOf, type Drawn, type Level, thinned } from "./tracks";

/** What the page says: where the cameras were, once, and which passes nobody wants to see. */
export interface Wish {
  drives?: Level;
  hidden: ReadonlySet<number>;
  /** The spacings of the levels that are needed. */
  levels: number[];
  /** What was hidden in an earlier turn does not matter any more. */
  turn: number;
}

/** What the page hears, of every level. */
export interface Made {
  drawn: Drawn;
  turn: number;
}

const thin = new Map<number, Level>();
const wishes: Wish[] = [];

onmessage = ({ data }: MessageEvent<Wish>) => {
  if (data.drives) thin.set(0, data.drives);
  wishes.push(data);
  if (wishes.length === 1) void work();
};

async function work(): Promise<void> {
  for (; wishes.length; wishes.shift()) {
    const { hidden, levels, turn } = wishes[0];
    for (const spacing of levels) {
      // To hear whether something else is hidden by now.
      await new Promise((resolve) => setTimeout(resolve));
      if (wishes[wishes.length - 1].turn !== turn) break;
      const level = thin.get(spacing) ?? thinned(thin.get(0)!, spacing);
      thin.set(spacing, level);
      const drawn = drawnOf(level, hidden);
      postMessage({ drawn, turn } satisfies Made, { transfer: buffersOf(drawn) });
    }
  }
}
