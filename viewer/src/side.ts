/** The rays of a label from the side: distance to the right, height upwards, both in the same scale where that shows something. */

import type { LabelDetails } from "./api";
import { css, passColor } from "./colors";
import { fixed, svg } from "./dom";

const WIDTH = 376;
const HEIGHT = 118;
const LEFT = 34;
const BOTTOM = 22;

export function sideView(details: LabelDetails, sigmaUp: number, originUp: number, dark: boolean): SVGSVGElement | null {
  const { voters, local_m: at } = details;
  if (!voters.length) return null;
  const rays = voters.map((shot) => ({
    pass: shot.pass,
    away: Math.hypot(shot.camera_m[0] - at[0], shot.camera_m[1] - at[1]),
    height: shot.camera_m[2],
  }));
  const farthest = Math.max(...rays.map((ray) => ray.away), 5) * 1.04;
  const low = Math.min(at[2] - 2 * sigmaUp, ...rays.map((ray) => ray.height)) - 0.5;
  const high = Math.max(at[2] + 2 * sigmaUp, ...rays.map((ray) => ray.height)) + 0.5;
  const x = (metres: number) => LEFT + (metres / farthest) * (WIDTH - LEFT - 8);
  const y = (metres: number) => 6 + ((high - metres) / (high - low)) * (HEIGHT - BOTTOM - 8);
  const drawing = svg("svg", {
    class: "side",
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
    role: "img",
    "aria-label": `Rays from the side: ${voters.length} cameras up to ${farthest.toFixed(0)} metres away`,
  });
  for (const metres of ticks(0, farthest, 5)) {
    drawing.append(
      svg("line", { class: "grid", x1: x(metres), x2: x(metres), y1: 6, y2: HEIGHT - BOTTOM }),
      svg("text", { x: x(metres), y: HEIGHT - 7, "text-anchor": "middle" }, metres === 0 ? "0 m" : String(metres)),
    );
  }
  for (const metres of ticks(low + originUp, high + originUp, 4)) {
    const at = y(metres - originUp);
    drawing.append(
      svg("line", { class: "grid", x1: LEFT, x2: WIDTH - 8, y1: at, y2: at }),
      svg("text", { x: LEFT - 4, y: at + 3, "text-anchor": "end" }, fixed(metres, Number.isInteger(metres) ? 0 : 1)),
    );
  }
  // Two shapes for each pass, not two for each of hundreds of rays; dots are lines without a length and with round ends.
  for (const pass of new Set(rays.map((ray) => ray.pass))) {
    const stroke = css(passColor(pass, dark));
    const path = (ends: (x: string, y: string) => string) =>
      rays.flatMap((ray) => (ray.pass === pass ? [ends(x(ray.away).toFixed(1), y(ray.height).toFixed(1))] : [])).join("");
    drawing.append(
      svg("path", { class: "ray", stroke, d: path((x0, y0) => `M${x0} ${y0}L${x(0)} ${y(at[2]).toFixed(1)}`) }),
      svg("path", { class: "from", stroke, d: path((x0, y0) => `M${x0} ${y0}h0`) }),
    );
  }
  drawing.append(
    svg("line", { class: "bar", x1: x(0), x2: x(0), y1: y(at[2] - 2 * sigmaUp), y2: y(at[2] + 2 * sigmaUp) }),
    svg("circle", { class: "at", cx: x(0), cy: y(at[2]), r: 4 }),
  );
  return drawing;
}

/** Round numbers between two, about so many. */
export function ticks(low: number, high: number, about: number): number[] {
  const rough = (high - low) / about;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10);
  const found: number[] = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(Number((i * step).toFixed(6)));
  return found;
}
