/** The panel on the right: what a label rests on, or why a place is empty; and what somebody decides about a label. */

import type { Head, Hypothesis, LabelDetails, PlaceDetails, Review, Verdict, Wish } from "./api";
import { fixed, h, plural, probability, time } from "./dom";
import { type Gallery, gallery } from "./shots";
import { sideView } from "./side";

export interface DetailEvents {
  onClose(): void;
  onLabel(id: number): void;
  onGo(east: number, north: number): void;
  onLight(shot: import("./api").Shot | null): void;
  onDecide(wish: Wish): void;
  onMove(id: number): void;
}

export interface LabelPanel {
  gallery: Gallery;
  wish(verdict: Verdict | null): Wish;
}

const STATE_TEXT = { open: "not reviewed", accepted: "accepted", rejected: "rejected", "check again": "please check again" };

function top(title: string, sub: (Node | string)[], events: DetailEvents): HTMLElement {
  return h(
    "div",
    { class: "top" },
    h("div", {}, h("h2", { tabindex: "-1", id: "title" }, title), h("p", { class: "sub" }, ...sub)),
    h("button", { class: "close", "aria-label": "Close (Escape)", title: "Close (Escape)", onclick: events.onClose }, "×"),
  );
}

function facts(rows: [string, string | Node][]): HTMLElement {
  return h("dl", { class: "facts" }, ...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
}

function place(details: LabelDetails | PlaceDetails): [string, string][] {
  const rows: [string, string][] = [["position", details.position_m.map((c) => fixed(c, 2)).join(", ") + " m"]];
  if (details.lon_lat_height) {
    const [lon, lat, height] = details.lon_lat_height;
    rows.push(["lat, lon", `${lat.toFixed(7)}, ${lon.toFixed(7)}`], ["height", fixed(height, 2, " m")]);
  }
  return rows;
}

export function renderLabel(
  panel: HTMLElement,
  details: LabelDetails,
  sigmas: { major: number; minor: number; up: number },
  review: Review,
  head: Head,
  dark: boolean,
  events: DetailEvents,
): LabelPanel {
  const wish = (verdict: Verdict | null): Wish => ({
    label_id: details.id,
    verdict: verdict ?? (classInput.value.trim() || note.value.trim() || review.moved_to ? "noted" : null),
    new_class: classInput.value.trim() === details.class ? null : classInput.value.trim() || null,
    moved_to: review.moved_to ?? null,
    note: note.value,
  });
  const verdictNow: Verdict | null = review.verdict ?? null;
  const classInput = h("input", { id: "class", list: "classes", value: review.new_class ?? details.class, autocomplete: "off", spellcheck: "false" });
  const note = h("textarea", { id: "note", rows: 2, placeholder: "Note", "aria-label": "Note" });
  note.value = review.note ?? "";
  const keep = () => events.onDecide(wish(verdictNow));
  classInput.addEventListener("change", keep);
  note.addEventListener("change", keep);
  const button = (verdict: Verdict, text: string, key: string) =>
    h(
      "button",
      {
        class: `verdict ${verdict}`,
        id: verdict === "accepted" ? "accept" : "reject",
        "aria-pressed": verdictNow === verdict ? "true" : "false",
        "aria-keyshortcuts": key,
        onclick: () => events.onDecide(wish(verdictNow === verdict ? null : verdict)),
      },
      text,
      h("kbd", {}, key),
    );
  const expected = details.expected !== null ? `${details.votes} of ${details.votes + details.misses.length || details.expected} images` : plural(details.votes, "image");
  const side = sideView(details, sigmas.up, head.origin[2], dark);
  const shots = gallery(
    head,
    dark,
    [
      { title: "Voted", hint: `${plural(details.voters.length, "image")}: box as detected, cross where the label projects`, shots: details.voters, byPass: true, missing: false },
      { title: "Should have seen it and did not", hint: plural(details.misses.length, "image"), shots: details.misses, byPass: true, missing: true },
    ],
    events.onLight,
  );
  const seen = details.first_seen_s === null ? [] : ([["seen", `${time(details.first_seen_s)} to ${time(details.last_seen_s)}`]] as [string, string][]);
  panel.replaceChildren(
    top(`Label ${details.id}`, [review.new_class ? `${details.class} → ${review.new_class}` : details.class, h("span", { class: `state ${review.state.replace(" ", "-")}` }, STATE_TEXT[review.state]), details.state === null ? "" : h("span", { class: `state update ${details.state}` }, details.state)], events),
    details.state === "gone" ? h("p", { class: "gone" }, "An update found that this label is no longer there. Its votes are from before.") : "",
    h(
      "div",
      { class: "hero" },
      figure(probability(details.existence), "existence"),
      figure(String(details.votes), details.votes === 1 ? "vote" : "votes"),
      figure(String(details.passes), details.passes === 1 ? "pass" : "passes"),
      figure(fixed(sigmas.major * 100, sigmas.major < 0.1 ? 1 : 0, " cm"), "σ, worst way"),
    ),
    review.state === "check again"
      ? h("p", { class: "alert", role: "alert" }, `${whyCheck(review, details.votes)} Please check again.`)
      : "",
    h(
      "div",
      { class: "review", role: "group", "aria-label": "Review" },
      button("accepted", "Accept", "A"),
      button("rejected", "Reject", "R"),
      h("button", { class: "verdict", id: "move", "aria-keyshortcuts": "M", onclick: () => events.onMove(details.id) }, review.moved_to ? "Moved" : "Move", h("kbd", {}, "M")),
    ),
    h("div", { class: "edit" }, h("label", { for: "class" }, "Class"), classInput, h("datalist", { id: "classes" }, ...head.classes.map((name) => h("option", { value: name }))), note),
    folding("numbers", "Numbers", "", facts([
      ["seen by", `${expected} that should have`],
      ["reprojection", fixed(details.rms_px, 2, " px rms")],
      ["σ across", `${fixed(sigmas.major, 3)} × ${fixed(sigmas.minor, 3)} m, height ${fixed(sigmas.up, 3, " m")}`],
      ["parallax", fixed(details.max_parallax_deg, 1, "°")],
      ...(details.size_m[0] || details.size_m[1] ? ([["size", `${fixed(details.size_m[0], 2)} × ${fixed(details.size_m[1], 2, " m")}`]] as [string, string][]) : []),
      ["faces", `${fixed(details.facing_deg, 0, "°")} (concentration ${fixed(details.facing_concentration, 2)})`],
      ...place(details),
      ...seen,
    ])),
    side ? folding("side", "Rays from the side", "distance and height in m; bar: ± 2 σ", side) : "",
    head.has.dataset ? shots.element : h("p", { class: "muted" }, "Without the dataset there are no votes to show: start with --dataset."),
  );
  return { gallery: shots, wish };
}

function whyCheck(review: Review, votes: number): string {
  if (review.verdict) return `Rejected with ${plural(review.votes_then ?? 0, "vote")}; now it has ${votes}.`;
  return `A label was rejected here${review.beside === null ? "" : `, now label ${review.beside}`}; it may have been this one.`;
}

/** A part that can be folded away, and stays so for the next label. */
function folding(name: string, title: string, hint: string, content: Element): HTMLElement {
  const part = h("details", { class: "folding", open: localStorage.getItem(`fold-${name}`) !== "closed" }, h("summary", {}, title, " ", h("small", {}, hint)), content);
  part.addEventListener("toggle", () => localStorage.setItem(`fold-${name}`, part.open ? "open" : "closed"));
  return part;
}

function figure(value: string, name: string): HTMLElement {
  return h("div", {}, h("b", {}, value), h("span", {}, name));
}

export function renderPlace(panel: HTMLElement, details: PlaceDetails, head: Head, dark: boolean, events: DetailEvents): Gallery {
  const labelLink = (id: number) => h("button", { class: "link", onclick: () => events.onLabel(id) }, `label ${id}`);
  const shots = gallery(
    head,
    dark,
    [
      { title: "Detections that point here", hint: "nearest first; free ones before those of other labels", shots: details.passing ?? [], byPass: false, missing: false },
      { title: "Pictures of this place", hint: "the nearest; the cross is the place", shots: details.pictured ?? [], byPass: false, missing: true },
    ],
    events.onLight,
  );
  const hypothesis = (each: Hypothesis) =>
    h(
      "li",
      {},
      h("button", { class: "link", onclick: () => events.onGo(each.local_m[0], each.local_m[1]) }, `${each.class}, ${each.away_m.toFixed(1)} m away`),
      h("span", { class: "muted" }, ` ${plural(each.votes, "vote")}, ${plural(each.passes, "pass", "passes")}${each.expected ? ` of ${each.expected} expected` : ""}${each.existence === null ? "" : `, existence ${probability(each.existence)}`}`),
      h("br"),
      `Rejected (${each.reason}): ${each.why}${each.figures ? ` (${each.figures})` : ""}. `,
      each.rival === null ? "" : h("span", {}, "See ", labelLink(each.rival), "."),
    );
  panel.replaceChildren(
    top("Why is there nothing here?", [`${fixed(details.local_m[0] + head.origin[0], 1)}, ${fixed(details.local_m[1] + head.origin[1], 1)} m`], events),
    h("p", { class: "answer", id: "answer" }, details.answer),
    details.takers?.length
      ? h("p", {}, "Detections that point here belong to ", ...details.takers.slice(0, 6).flatMap((taker, i) => [i ? ", " : "", labelLink(taker.id), ` (${taker.rays})`]), details.takers.length > 6 ? " and others." : ".")
      : "",
    details.rejected.length ? h("h3", {}, "Rejected hypotheses ", h("small", {}, "within 2 m")) : "",
    details.rejected.length ? h("ul", { class: "hypotheses" }, ...details.rejected.slice(0, 12).map(hypothesis)) : "",
    details.labels.length ? h("h3", {}, "Labels near it") : "",
    details.labels.length ? h("ul", { class: "near" }, ...details.labels.slice(0, 8).map((each) => h("li", {}, labelLink(each.id), ` ${each.class}, ${each.away_m.toFixed(1)} m${each.state === "gone" ? ", gone" : ""}`))) : "",
    shots.element,
  );
  return shots;
}

export function renderProblem(panel: HTMLElement, title: string, message: string, events: DetailEvents): void {
  panel.replaceChildren(top(title, [], events), h("p", { class: "alert", role: "alert" }, message));
}
