/** What is shown and how: filters, layers, the place and what is selected; kept in the address after #. */

import type { Head, State } from "./api";

export type ColorBy = "existence" | "class" | "state" | "update" | "outcome";
export type LayerName = "ellipses" | "tracks" | "cameras" | "truth" | "rejected";
export type Selection = { kind: "label"; id: number } | { kind: "place"; east: number; north: number } | null;

export const ALL_STATES: State[] = ["open", "accepted", "rejected", "check again"];
export const ALL_LAYERS: LayerName[] = ["ellipses", "tracks", "cameras", "truth", "rejected"];

export interface Settings {
  colorBy: ColorBy;
  layers: Set<LayerName>;
  hiddenClasses: Set<string>;
  hiddenStates: Set<State>;
  /** Of what an update says. */
  hiddenUpdates: Set<string>;
  hiddenPasses: Set<number>;
  minExistence: number;
  maxExistence: number;
  minVotes: number;
  minPasses: number;
}

export interface View {
  east: number;
  north: number;
  /** Pixels of a metre, as a power of two. */
  zoom: number;
}

export function defaults(head: Head): Settings {
  return {
    colorBy: head.has.existence ? "existence" : "class",
    layers: new Set<LayerName>(["ellipses", "tracks", "cameras", ...(head.has.truth ? ["truth" as const] : [])]),
    hiddenClasses: new Set(),
    hiddenStates: new Set(),
    hiddenUpdates: new Set(),
    hiddenPasses: new Set(),
    minExistence: 0,
    maxExistence: 1,
    minVotes: 0,
    minPasses: 0,
  };
}

export function toHash(settings: Settings, view: View, selection: Selection, head: Head): string {
  const plain = defaults(head);
  const hash = new URLSearchParams();
  // In the world's metres: the page's own origin is another one when the map is made again.
  const [x, y] = head.origin;
  hash.set("at", `${(view.east + x).toFixed(2)},${(view.north + y).toFixed(2)}`);
  hash.set("z", view.zoom.toFixed(2));
  if (selection?.kind === "label") hash.set("label", String(selection.id));
  if (selection?.kind === "place") hash.set("place", `${(selection.east + x).toFixed(2)},${(selection.north + y).toFixed(2)}`);
  if (settings.colorBy !== plain.colorBy) hash.set("by", settings.colorBy);
  const layers = [...settings.layers].sort().join(",");
  if (layers !== [...plain.layers].sort().join(",")) hash.set("layers", layers);
  for (const name of [...settings.hiddenClasses].sort()) hash.append("without", name);
  if (settings.hiddenStates.size) hash.set("states", ALL_STATES.filter((s) => !settings.hiddenStates.has(s)).join(","));
  for (const name of [...settings.hiddenUpdates].sort()) hash.append("noupdate", name);
  if (settings.hiddenPasses.size) hash.set("nopass", [...settings.hiddenPasses].sort((a, b) => a - b).join(","));
  if (settings.minExistence > 0) hash.set("min", String(settings.minExistence));
  if (settings.maxExistence < 1) hash.set("max", String(settings.maxExistence));
  if (settings.minVotes > 0) hash.set("votes", String(settings.minVotes));
  if (settings.minPasses > 0) hash.set("passes", String(settings.minPasses));
  return `#${hash.toString()}`;
}

export function fromHash(text: string, head: Head): { settings: Settings; view: View | null; selection: Selection } {
  const hash = new URLSearchParams(text.replace(/^#/, ""));
  const settings = defaults(head);
  const by = hash.get("by");
  if (by === "existence" || by === "class" || by === "state" || by === "update" || by === "outcome") settings.colorBy = by;
  if (hash.has("layers")) {
    const wanted = (hash.get("layers") ?? "").split(",");
    settings.layers = new Set(ALL_LAYERS.filter((name) => wanted.includes(name)));
  }
  settings.hiddenClasses = new Set(hash.getAll("without"));
  if (hash.has("states")) {
    const wanted = (hash.get("states") ?? "").split(",");
    settings.hiddenStates = new Set(ALL_STATES.filter((state) => !wanted.includes(state)));
  }
  settings.hiddenUpdates = new Set(hash.getAll("noupdate"));
  settings.hiddenPasses = new Set(numbers(hash.get("nopass")));
  settings.minExistence = bounded(hash.get("min"), 0, 1, 0);
  settings.maxExistence = bounded(hash.get("max"), 0, 1, 1);
  settings.minVotes = bounded(hash.get("votes"), 0, 1e6, 0);
  settings.minPasses = bounded(hash.get("passes"), 0, 1e6, 0);
  const at = numbers(hash.get("at"));
  const zoom = bounded(hash.get("z"), MIN_ZOOM, MAX_ZOOM, NaN);
  const place = numbers(hash.get("place"));
  const label = Number(hash.get("label") ?? NaN);
  let selection: Selection = null;
  if (Number.isInteger(label)) selection = { kind: "label", id: label };
  else if (place.length === 2) selection = { kind: "place", east: place[0] - head.origin[0], north: place[1] - head.origin[1] };
  const view = at.length === 2 && Number.isFinite(zoom) ? { east: at[0] - head.origin[0], north: at[1] - head.origin[1], zoom } : null;
  return { settings, view, selection };
}

export const MIN_ZOOM = -9;
export const MAX_ZOOM = 9;

function numbers(text: string | null): number[] {
  const parts = (text ?? "").split(",").filter((part) => part !== "").map(Number);
  return parts.every(Number.isFinite) ? parts : [];
}

function bounded(text: string | null, low: number, high: number, otherwise: number): number {
  const value = text === null || text === "" ? NaN : Number(text);
  return Number.isFinite(value) ? Math.min(high, Math.max(low, value)) : otherwise;
}
