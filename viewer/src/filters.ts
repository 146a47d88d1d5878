/** The panel on the left: colours, layers, filters, passes, and the labels as a list, the most doubtful first. */

import type { Head, Lost, State } from "./api";
import { classColor, css, passColor, STATES, UPDATES } from "./colors";
import { byId, count, h, plural, probability, svg } from "./dom";
import type { Labels } from "./map";
import { ALL_STATES, type ColorBy, type LayerName, type Settings } from "./state";

const LISTED = 200;

export interface FilterEvents {
  onChange(): void;
  onLabel(id: number): void;
  onGo(east: number, north: number): void;
}

const LAYER_TEXT: Record<LayerName, string> = {
  ellipses: "95 % ellipses",
  tracks: "Tracks",
  cameras: "Cameras",
  truth: "Truth",
  rejected: "Rejected hypotheses",
};

const STATE_TEXT: Record<State, string> = {
  open: "Not reviewed",
  accepted: "Accepted",
  rejected: "Rejected",
  "check again": "Check again",
};

export class Filters {
  private readonly list = h("ol", { id: "list", tabindex: "-1", "aria-label": "Labels, the most doubtful first" });
  private readonly listTitle = h("h2", {}, "Labels");
  private readonly stateCounts = new Map<State, HTMLElement>();
  private readonly lost = h("div", { id: "lost" });
  private order = new Uint32Array();

  constructor(
    private readonly panel: HTMLElement,
    private readonly head: Head,
    private readonly labels: Labels,
    private readonly settings: Settings,
    private readonly events: FilterEvents,
  ) {}

  render(dark: boolean): void {
    const { head, settings, labels } = this;
    const colorings: [ColorBy, string, boolean][] = [
      ["existence", "Existence", head.has.existence],
      ["class", "Class", true],
      ["state", "Review", true],
      ["update", "Update", head.states.length > 0],
      ["outcome", "Truth", head.has.truth],
    ];
    const layers: [LayerName, boolean][] = [
      ["ellipses", true],
      ["tracks", head.has.dataset],
      ["cameras", head.has.dataset],
      ["truth", head.has.truth],
      ["rejected", head.has.rejected],
    ];
    const perClass = new Array<number>(head.classes.length).fill(0);
    for (const code of labels.class) perClass[code]++;
    const perUpdate = new Map(head.states.map((state) => [state, 0]));
    for (const state of labels.update) if (state !== undefined) perUpdate.set(state, perUpdate.get(state)! + 1);
    const maxVotes = labels.votes.reduce((a, b) => Math.max(a, b), 1);
    const maxPasses = labels.passes.reduce((a, b) => Math.max(a, b), 1);
    this.panel.replaceChildren(
      h(
        "fieldset",
        { class: "segments" },
        h("legend", {}, "Colour"),
        ...colorings
          .filter(([, , there]) => there)
          .map(([value, text]) =>
            h("label", {}, h("input", { type: "radio", name: "color", value, checked: settings.colorBy === value, onchange: () => this.change(() => (settings.colorBy = value)) }), h("span", {}, text)),
          ),
      ),
      h(
        "fieldset",
        { class: "chips" },
        h("legend", {}, "Show"),
        ...layers
          .filter(([, there]) => there)
          .map(([name]) =>
            this.check(LAYER_TEXT[name], settings.layers.has(name), (on) => (on ? settings.layers.add(name) : settings.layers.delete(name))),
          ),
      ),
      h(
        "fieldset",
        {},
        h("legend", {}, "Class"),
        ...head.classes.map((name, code) =>
          this.check(name, !settings.hiddenClasses.has(name), (on) => (on ? settings.hiddenClasses.delete(name) : settings.hiddenClasses.add(name)), dot(css(classColor(code))), count(perClass[code])),
        ),
      ),
      h(
        "fieldset",
        {},
        h("legend", {}, "Filter"),
        head.has.existence ? this.range("existence ≥", 0, 1, 0.01, settings.minExistence, (v) => v.toFixed(2), (v) => (settings.minExistence = v)) : "",
        this.range("votes ≥", 0, Math.min(maxVotes, 100), 1, settings.minVotes, String, (v) => (settings.minVotes = v)),
        this.range("passes ≥", 0, Math.min(maxPasses, 50), 1, settings.minPasses, String, (v) => (settings.minPasses = v)),
        head.has.existence ? this.range("existence ≤", 0, 1, 0.01, settings.maxExistence, (v) => v.toFixed(2), (v) => (settings.maxExistence = v)) : "",
      ),
      h(
        "fieldset",
        {},
        h("legend", {}, "Review"),
        ...ALL_STATES.map((state) => {
          const number = h("span", { class: "count" });
          this.stateCounts.set(state, number);
          return this.check(STATE_TEXT[state], !settings.hiddenStates.has(state), (on) => (on ? settings.hiddenStates.delete(state) : settings.hiddenStates.add(state)), dot(css(STATES[state])), number);
        }),
        this.lost,
      ),
      head.states.length
        ? h(
            "fieldset",
            { id: "updates" },
            h("legend", {}, "Update"),
            ...head.states.map((state) =>
              this.check(state, !settings.hiddenUpdates.has(state), (on) => (on ? settings.hiddenUpdates.delete(state) : settings.hiddenUpdates.add(state)), dot(css(UPDATES[state] ?? STATES.open)), count(perUpdate.get(state) ?? 0)),
            ),
          )
        : "",
      head.passes.length
        ? h(
            "details",
            { class: "passes" },
            h("summary", {}, plural(head.passes.length, "pass", "passes")),
            ...head.passes
              .slice(0, 400)
              .map((pass, number) =>
                this.check(pass.name, !settings.hiddenPasses.has(number), (on) => (on ? settings.hiddenPasses.delete(number) : settings.hiddenPasses.add(number)), dot(css(passColor(number, dark))), count(pass.images)),
              ),
          )
        : "",
      this.listTitle,
      this.list,
    );
  }

  private change(apply: () => void): void {
    apply();
    this.events.onChange();
  }

  private check(text: string, checked: boolean, apply: (on: boolean) => void, mark?: Node, end?: Node | string): HTMLElement {
    const input = h("input", { type: "checkbox", checked });
    input.addEventListener("change", () => this.change(() => apply(input.checked)));
    return h("label", { class: "check" }, input, mark ?? "", h("span", { class: "text", title: text }, text), typeof end === "string" ? h("span", { class: "count" }, end) : (end ?? ""));
  }

  private range(name: string, min: number, max: number, step: number, value: number, text: (v: number) => string, apply: (v: number) => void): HTMLElement {
    const shown = h("output", {}, text(value));
    const input = h("input", { type: "range", min, max, step, value, "aria-label": name });
    input.addEventListener("input", () => {
      shown.textContent = text(Number(input.value));
      this.change(() => apply(Number(input.value)));
    });
    return h("label", { class: "range" }, h("span", {}, name), input, shown);
  }

  /** List what is shown now. */
  update(shown: Uint32Array, states: State[], lost: Lost[], selected: number | null): void {
    const { labels } = this;
    const doubt = (row: number) => (Number.isFinite(labels.existence[row]) ? labels.existence[row] : labels.votes[row]);
    const urgent = (row: number) => (labels.update[row] === "gone" ? 3 : states[row] === "check again" ? 0 : states[row] === "open" ? 1 : 2);
    // One number for each label, so that sorting compares nothing but numbers.
    const key = new Float64Array(labels.count);
    for (const row of shown) key[row] = 1e9 * urgent(row) + doubt(row);
    this.order = shown.slice().sort((a, b) => key[a] - key[b] || a - b);
    this.listTitle.replaceChildren("Labels ", h("small", {}, labels.count ? `${count(shown.length)} of ${count(labels.count)}, ${this.head.counts.gone ? `${count(this.head.counts.gone)} gone, ` : ""}doubtful first` : "none"));
    const listed = Array.from(this.order.subarray(0, LISTED));
    this.list.replaceChildren(
      ...listed.map((row) => {
        const id = labels.id[row];
        return h(
          "li",
          {},
          h(
            "button",
            { title: `${labels.update[row] === "gone" ? "gone; " : ""}existence ${probability(labels.existence[row])}, ${plural(labels.votes[row], "vote")}`, "aria-current": id === selected ? "true" : "false", "data-label": id, onclick: () => this.events.onLabel(id) },
            dot(css(STATES[states[row]]), states[row]),
            h("b", {}, String(id)),
            h("span", { class: "text" }, this.head.classes[labels.class[row]]),
            h("span", { class: "count" }, labels.update[row] === "gone" ? "gone" : Number.isFinite(labels.existence[row]) ? `${probability(labels.existence[row])} · ${labels.votes[row]}` : count(labels.votes[row])),
          ),
        );
      }),
      ...(this.order.length ? [] : [h("li", { class: "muted" }, labels.count ? "No label passes the filters." : "This map has no labels. Click a place to read why there is nothing.")]),
      ...(this.order.length > LISTED ? [h("li", { class: "muted" }, `and ${count(this.order.length - LISTED)} more: filter, or search by id`)] : []),
    );
    const perState = new Map<State, number>();
    for (const state of states) perState.set(state, (perState.get(state) ?? 0) + 1);
    for (const [state, number] of this.stateCounts) number.textContent = count(perState.get(state) ?? 0);
    this.lost.replaceChildren(
      ...(lost.length
        ? [
            h(
              "details",
              {},
              h("summary", {}, `${plural(lost.length, "decision")} about nothing in this map`),
              ...lost.slice(0, 100).map((each) => h("button", { class: "link", onclick: () => this.events.onGo(each.local_m[0], each.local_m[1]) }, `${each.verdict}: ${each.class}, then label ${each.label_id}`)),
            ),
          ]
        : []),
    );
  }

  mark(id: number | null): void {
    this.list.querySelector("[aria-current=true]")?.setAttribute("aria-current", "false");
    const marked = id === null ? null : this.list.querySelector(`[data-label="${id}"]`);
    marked?.setAttribute("aria-current", "true");
    marked?.scrollIntoView({ block: "nearest" });
  }

  /** The label after (1) or before (-1) one in the list. */
  neighbor(id: number | null, by: number): number | null {
    if (!this.order.length) return null;
    const at = id === null ? -1 : this.order.findIndex((row) => this.labels.id[row] === id);
    const next = at < 0 ? 0 : Math.min(this.order.length - 1, Math.max(0, at + by));
    return this.labels.id[this.order[next]];
  }
}

/** A colour as a dot; the policy of the page allows no style in attributes, so it is drawn. */
export function dot(color: string, title = ""): SVGSVGElement {
  return svg("svg", { class: "dot", viewBox: "0 0 2 2", role: title ? "img" : "presentation", "aria-label": title || null }, svg("circle", { cx: 1, cy: 1, r: 1, fill: color }));
}

export const searchBox = (): HTMLInputElement => byId<HTMLInputElement>("search");
