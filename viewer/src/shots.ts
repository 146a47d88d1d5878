/** Pictures as evidence: crops with the box and the place where the label projects, by pass. */

import { api, type Head, type Shot } from "./api";
import { css, passColor } from "./colors";
import { byId, fixed, h, plural, svg, time } from "./dom";

/** Draw what was detected (box) and what is expected (cross) over a part of a picture, in its own pixels. */
function overlay(shot: Shot, left: number, top: number, width: number, height: number, arm = width / 14): SVGSVGElement {
  const drawing = svg("svg", {
    viewBox: `${left} ${top} ${width} ${height}`,
    preserveAspectRatio: "none",
    "aria-hidden": "true",
  });
  // Where there is no picture the frame of it is what there is to see.
  if (!shot.picture) drawing.append(svg("rect", { class: "frame", x: 0, y: 0, width: shot.size[0], height: shot.size[1] }));
  const [x, y, w, tall] = shot.box ?? [null, null, null, null];
  if (x !== null && y !== null) {
    if (w && tall) {
      const place = { x: x - w / 2, y: y - tall / 2, width: w, height: tall };
      drawing.append(svg("rect", { class: "box under", ...place }), svg("rect", { class: "box", ...place }));
    } else {
      drawing.append(svg("circle", { class: "box", cx: x, cy: y, r: width / 40 }));
    }
  }
  const [px, py] = shot.projected ?? [null, null];
  if (px !== null && py !== null) {
    const path = `M${px - arm} ${py}H${px + arm}M${px} ${py - arm}V${py + arm}`;
    drawing.append(svg("path", { class: "cross under", d: path }), svg("path", { class: "cross", d: path }));
  }
  return drawing;
}

function crop(shot: Shot, side: number): HTMLElement {
  const [x, y] = shot.crop;
  const box = h("span", { class: shot.picture ? "crop" : "crop empty" });
  if (x === null || y === null) return box;
  if (shot.picture) box.append(h("img", { src: api.crop(shot, side), alt: "", loading: "lazy", decoding: "async", draggable: "false" }));
  box.append(overlay(shot, x - side / 2, y - side / 2, side, side));
  return box;
}

function figures(shot: Shot): string {
  if (shot.residual_px !== undefined) return `${fixed(shot.residual_px, 1, " px")} · ${fixed(shot.residual_sigmas, 1, " σ")}`;
  if (shot.miss_m !== undefined) return `passes ${fixed(shot.miss_m, 2, " m")} away`;
  if (shot.nearest_px !== null && shot.nearest_px !== undefined) return `nearest box ${fixed(shot.nearest_px, 0, " px")}`;
  return "no box";
}

/** Who has the detection that is nearest to where a label should be. */
function taker(shot: Shot): string {
  const label = shot.nearest_label ?? shot.label;
  return label === null || label === undefined ? "" : ` (label ${label} has it)`;
}

/** Small pictures that are there at once: more than a panel shows. */
const FIRST = 15;

export interface Gallery {
  element: HTMLElement;
  /** Go to another picture: 1 is the next, -1 the one before. */
  step(by: number): void;
  open(): void;
}

/** Show pictures in groups, one of them large; `onLight` hears which. */
export function gallery(
  head: Head,
  dark: boolean,
  groups: { title: string; hint: string; shots: Shot[]; byPass: boolean; missing: boolean }[],
  onLight: (shot: Shot | null) => void,
): Gallery {
  const shots = groups.flatMap((group) => group.shots);
  const large = h("div", { class: "large" });
  const buttons: HTMLButtonElement[] = [];
  let current = -1;

  function select(index: number, scroll: boolean): void {
    if (!shots.length) return;
    fill(index + 1);
    buttons[current]?.setAttribute("aria-current", "false");
    current = Math.min(shots.length - 1, Math.max(0, index));
    const shot = shots[current];
    buttons[current].setAttribute("aria-current", "true");
    if (scroll) buttons[current].scrollIntoView({ block: "nearest" });
    const wide = h("button", { class: "zoom", title: "The whole picture (Enter)", onclick: open }, crop(shot, shot.crop[2]));
    large.replaceChildren(
      wide,
      h(
        "div",
        { class: "caption" },
        h("strong", {}, figures(shot)),
        h("span", {}, `${fixed(shot.distance_m, 1, " m")} away${shot.score == null ? "" : ` · score ${fixed(shot.score, 2)}`}${shot.time_s === null ? "" : ` · ${time(shot.time_s)}`}${taker(shot)}`),
        h("span", { class: "name", title: shot.name }, shot.name),
        h("span", { class: "muted" }, `${current + 1} of ${shots.length} · ← → to go through them, Enter for the whole picture`),
      ),
    );
    onLight(shot);
  }

  function open(): void {
    if (current >= 0) showWhole(shots[current]);
  }

  const element = h("div", { class: "gallery" }, large);
  const strips: { strip: HTMLElement; shots: Shot[]; missing: boolean }[] = [];
  for (const group of groups) {
    if (!group.shots.length) continue;
    element.append(h("h3", {}, `${group.title} `, h("small", {}, group.hint)));
    const parts = group.byPass ? byPass(group.shots) : [{ pass: -1, shots: group.shots }];
    for (const part of parts) {
      if (part.pass >= 0) {
        const dot = svg("svg", { class: "dot", viewBox: "0 0 2 2", "aria-hidden": "true" }, svg("circle", { cx: 1, cy: 1, r: 1, fill: css(passColor(part.pass, dark)) }));
        element.append(h("h4", {}, dot, head.passes[part.pass]?.name ?? `pass ${part.pass}`, h("small", {}, ` ${plural(part.shots.length, "image")}${rms(part.shots)}`)));
      }
      const strip = h("div", { class: "strip" });
      strips.push({ strip, shots: part.shots, missing: group.missing });
      element.append(strip);
    }
  }

  function thumb(shot: Shot, at: number, missing: boolean): HTMLButtonElement {
    return h(
      "button",
      {
        class: missing ? "thumb missing" : "thumb",
        title: `${shot.name}: ${figures(shot)}`,
        "aria-label": `${shot.name}, ${figures(shot)}, ${fixed(shot.distance_m, 0, " metres")} away`,
        onclick: () => select(at, false),
      },
      crop(shot, shot.crop[2]),
      h("span", { class: (shot.residual_sigmas ?? 0) > 3 ? "tag bad" : "tag" }, shot.residual_px !== undefined ? fixed(shot.residual_sigmas, 1, " σ") : fixed(shot.distance_m, 0, " m")),
    );
  }

  let strip = 0;
  let inStrip = 0;
  /** Make at least so many of the small pictures: hundreds at once would make a click wait. */
  function fill(wanted: number): void {
    while (buttons.length < Math.min(wanted, shots.length)) {
      const { strip: parent, shots: part, missing } = strips[strip];
      const button = thumb(part[inStrip], buttons.length, missing);
      buttons.push(button);
      parent.append(button);
      if (++inStrip === part.length) [strip, inStrip] = [strip + 1, 0];
    }
    if (buttons.length === shots.length) element.dataset.complete = "true";
  }
  function fillOn(deadline: IdleDeadline): void {
    if (!element.isConnected) return;
    do fill(buttons.length + 4);
    while (buttons.length < shots.length && deadline.timeRemaining() > 4);
    if (buttons.length < shots.length) requestIdleCallback(fillOn, { timeout: 300 });
  }
  fill(FIRST);
  if (shots.length > buttons.length) requestIdleCallback(fillOn, { timeout: 300 });

  if (shots.length) select(0, false);
  else large.remove();
  return { element, step: (by) => select(current + by, by !== 0), open };
}

function byPass(shots: Shot[]): { pass: number; shots: Shot[] }[] {
  const parts: { pass: number; shots: Shot[] }[] = [];
  for (const shot of shots) {
    const last = parts[parts.length - 1];
    if (last?.pass === shot.pass) last.shots.push(shot);
    else parts.push({ pass: shot.pass, shots: [shot] });
  }
  return parts;
}

function rms(shots: Shot[]): string {
  const residuals = shots.map((shot) => shot.residual_px).filter((value): value is number => typeof value === "number");
  if (!residuals.length) return "";
  return ` · ${Math.sqrt(residuals.reduce((sum, value) => sum + value * value, 0) / residuals.length).toFixed(1)} px rms`;
}

function showWhole(shot: Shot): void {
  const [width, height] = shot.size;
  const picture = h("div", { class: shot.picture ? "whole" : "whole empty" });
  picture.style.aspectRatio = `${width} / ${height}`;
  picture.style.maxWidth = `calc(86vh * ${width / height})`;
  if (shot.picture) picture.append(h("img", { src: api.picture(shot), alt: `The picture ${shot.name}` }));
  picture.append(overlay(shot, 0, 0, width, height, width / 50));
  const close = h("button", { class: "close", "aria-label": "Close", onclick: () => dialog.close() }, "×");
  const dialog = h("dialog", { id: "whole" }, close, picture, h("p", {}, `${shot.name} · ${width} × ${height} px · ${figures(shot)}`));
  dialog.addEventListener("close", () => dialog.remove());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  byId("details").append(dialog);
  dialog.showModal();
}
