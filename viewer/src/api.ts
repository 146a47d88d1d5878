/** What the server of `valuemap view` answers. Lengths are metres, local: east, north, up from the page's origin. */

import { Columns } from "./columns";

export type Verdict = "accepted" | "rejected" | "noted";
export type State = "open" | "accepted" | "rejected" | "check again";

export interface Head {
  name: string;
  folder: string;
  anchor: { lat: number; lon: number; height: number } | null;
  origin: [number, number, number];
  classes: string[];
  passes: { name: string; images: number }[];
  /** Labels that are there, and those that an update found to be gone. */
  counts: { labels: number; gone: number; images: number; detections: number };
  has: { dataset: boolean; pictures: boolean; truth: boolean; rejected: boolean; existence: boolean };
  rejected: { classes: string[]; reasons: string[] } | null;
  outcomes: string[];
  /** What `valuemap update` says about labels; none where the map was never updated. */
  states: string[];
  method: string;
  version: string;
  notes: string[];
  basemap: { style?: string; tiles?: string } | null;
}

export interface Shot {
  image: number;
  name: string;
  pass: number;
  picture: boolean;
  size: [number, number];
  camera_m: [number, number, number];
  time_s: number | null;
  box: [number | null, number | null, number | null, number | null] | null;
  projected: [number | null, number | null] | null;
  crop: [number | null, number | null, number];
  distance_m: number | null;
  score?: number | null;
  residual_px?: number | null;
  residual_sigmas?: number | null;
  nearest_px?: number | null;
  nearest_label?: number | null;
  miss_m?: number | null;
  class?: string;
  label?: number | null;
}

export interface LabelDetails {
  id: number;
  class: string;
  /** What `valuemap update` says about it. */
  state: string | null;
  position_m: number[];
  local_m: [number, number, number];
  lon_lat_height: number[] | null;
  votes: number;
  passes: number;
  expected: number | null;
  existence: number | null;
  rms_px: number | null;
  max_parallax_deg: number | null;
  size_m: [number | null, number | null];
  facing_deg: number | null;
  facing_concentration: number | null;
  first_seen_s: number | null;
  last_seen_s: number | null;
  voters: Shot[];
  misses: Shot[];
}

export interface Hypothesis {
  id: number;
  class: string;
  local_m: [number, number, number];
  away_m: number;
  votes: number;
  passes: number;
  expected: number | null;
  existence: number | null;
  reason: string;
  why: string;
  /** What the test saw and what it asks for, in words. */
  figures: string | null;
  rival: number | null;
}

export interface PlaceDetails {
  answer: string;
  kept: boolean;
  local_m: [number, number, number];
  position_m: number[];
  lon_lat_height: number[] | null;
  rejected: Hypothesis[];
  labels: { id: number; class: string; state: string | null; away_m: number }[];
  looks?: number;
  look_passes?: number;
  rays?: number;
  free_rays?: number;
  takers?: { id: number; rays: number }[];
  passing?: Shot[];
  pictured?: Shot[];
}

export interface Review {
  label_id: number;
  state: State;
  verdict?: Verdict;
  new_class?: string | null;
  moved_to?: [number, number] | null;
  note?: string;
  votes_then?: number;
  /** A label that was rejected, and that this one may be as well; null where the map no longer has it. */
  beside?: number | null;
}

export interface Lost {
  label_id: number;
  verdict: Verdict;
  class: string;
  note: string;
  local_m: [number, number, number];
}

export interface Wish {
  label_id: number;
  verdict: Verdict | null;
  new_class?: string | null;
  moved_to?: [number, number] | null;
  note?: string;
}

async function ask(path: string, init?: RequestInit): Promise<Response> {
  const answer = await fetch(path, { credentials: "same-origin", ...init });
  if (!answer.ok) {
    const told = await answer.json().catch(() => null);
    throw new Error(told?.error ?? `the server answered ${answer.status}`);
  }
  return answer;
}

const json = async <T>(path: string, init?: RequestInit): Promise<T> => (await ask(path, init)).json() as Promise<T>;
const columns = async (path: string): Promise<Columns> => new Columns(await (await ask(path)).arrayBuffer());

export const api = {
  head: () => json<Head>("/api/map"),
  labels: () => columns("/api/labels"),
  cameras: () => columns("/api/cameras"),
  truth: () => columns("/api/truth"),
  rejected: () => columns("/api/rejected"),
  reviews: () => json<{ decisions: Review[]; without_label: Lost[] }>("/api/reviews"),
  label: (id: number) => json<LabelDetails>(`/api/label?id=${id}`),
  place: (east: number, north: number) => json<PlaceDetails>(`/api/place?east=${east}&north=${north}`),
  decide: (wish: Wish) =>
    json<Review>("/api/reviews", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(wish),
    }),
  crop: (shot: Shot, side = shot.crop[2]) =>
    `/api/crop?image=${shot.image}&x=${shot.crop[0]}&y=${shot.crop[1]}&side=${side}`,
  picture: (shot: Shot) => `/api/picture?image=${shot.image}`,
};
