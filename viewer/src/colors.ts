/** Colours: Okabe and Ito's, which people with any kind of colour vision can tell apart, and hues where there are more. */

import type { State } from "./api";

export type Color = [number, number, number];

const OKABE_ITO: Color[] = [
  [0, 114, 178],
  [230, 159, 0],
  [0, 158, 115],
  [204, 121, 167],
  [86, 180, 233],
  [213, 94, 0],
  [240, 228, 66],
];

export const STATES: Record<State, Color> = {
  open: [86, 140, 200],
  accepted: [0, 158, 115],
  rejected: [150, 150, 150],
  "check again": [213, 60, 150],
};

/** What an update says about labels. */
export const UPDATES: Record<string, Color> = {
  confirmed: [0, 114, 178],
  new: [0, 158, 115],
  moved: [204, 121, 167],
  uncertain: [230, 159, 0],
  gone: [140, 140, 140],
};

export const OUTCOMES: Record<string, Color> = {
  true: [0, 114, 178],
  duplicate: [230, 159, 0],
  false: [213, 94, 0],
  gone: UPDATES.gone,
  found: [0, 158, 115],
  missed: [213, 94, 0],
  "not recoverable": [140, 140, 140],
};

/** Doubtful labels are orange, certain ones blue; most are near 1, so the scale is finer there. */
export const EXISTENCE: [number, Color][] = [
  [0, [213, 70, 0]],
  [0.5, [230, 130, 0]],
  [0.8, [214, 178, 60]],
  [0.95, [86, 180, 233]],
  [1, [0, 114, 178]],
];

/** On a dark ground the certain end is lighter. */
export const existenceScale = (dark: boolean): [number, Color][] =>
  dark ? [...EXISTENCE.slice(0, 3), [0.95, [150, 205, 225]], [1, [70, 170, 240]]] : EXISTENCE;

export function existenceColor(value: number, dark: boolean): Color {
  if (!Number.isFinite(value)) return [86, 140, 200];
  const scale = existenceScale(dark);
  for (let i = 1; i < scale.length; i++) {
    const [high, to] = scale[i];
    const [low, from] = scale[i - 1];
    if (value <= high) {
      const t = Math.max(0, (value - low) / (high - low));
      return from.map((c, k) => Math.round(c + t * (to[k] - c))) as Color;
    }
  }
  return scale[scale.length - 1][1];
}

export function classColor(code: number): Color {
  return OKABE_ITO[code] ?? hue(code, 0.55, 0.5);
}

export function passColor(number: number, dark: boolean): Color {
  return hue(number, 0.55, dark ? 0.62 : 0.45);
}

/** The golden angle puts successive hues far apart. */
function hue(index: number, saturation: number, lightness: number): Color {
  const angle = (index * 137.508 + 20) % 360;
  const chroma = saturation * Math.min(lightness, 1 - lightness);
  return [0, 8, 4].map((shift) => {
    const k = (shift + angle / 30) % 12;
    return Math.round(255 * (lightness - chroma * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  }) as Color;
}

/** A colour and its opacity (0 to 255) as the four bytes that the GPU reads, for arrays with an element for each colour. */
export const packed = ([red, green, blue]: Color, opacity: number): number => (red | (green << 8) | (blue << 16) | (opacity << 24)) >>> 0;

export const css = (color: Color): string => `rgb(${color.join(" ")})`;
