/** MapLibre beneath the labels, loaded only where the user gave a basemap; it follows the view and hears no events. */

import * as maplibregl from "maplibre-gl";
import type { StyleSpecification } from "maplibre-gl";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?worker&url";
import "maplibre-gl/dist/maplibre-gl.css";
import { PMTiles, Protocol } from "pmtiles";
import { geographic } from "./geodesy";
import type { View } from "./state";

const EQUATOR_M = 40075016.686;

export class Basemap {
  private constructor(
    private readonly map: maplibregl.Map,
    private readonly anchor: { lat: number; lon: number; height: number },
  ) {}

  static async create(
    container: HTMLElement,
    anchor: { lat: number; lon: number; height: number },
    source: { style?: string; tiles?: string },
    dark: boolean,
    onAttribution: (text: string) => void,
  ): Promise<Basemap> {
    maplibregl.setWorkerUrl(workerUrl);
    const style = source.style ?? (await styleOfTiles(source.tiles!, dark, onAttribution));
    const map = new maplibregl.Map({ container, style, interactive: false, attributionControl: source.style ? {} : false, fadeDuration: 0 });
    return new Basemap(map, anchor);
  }

  follow(view: View): void {
    const { lat, lon, convergence } = geographic(this.anchor, view.east, view.north);
    const metres = EQUATOR_M * Math.cos((lat * Math.PI) / 180);
    this.map.jumpTo({ center: [lon, lat], zoom: Math.log2((metres * 2 ** view.zoom) / 512), bearing: -convergence });
  }
}

/** Draw whatever layers tiles have in quiet colours: nobody knows the names in a file of somebody else. */
async function styleOfTiles(path: string, dark: boolean, onAttribution: (text: string) => void): Promise<StyleSpecification> {
  const url = new URL(path, location.href).href;
  const tiles = new PMTiles(url);
  const protocol = new Protocol();
  protocol.add(tiles);
  maplibregl.addProtocol("pmtiles", protocol.tile);
  const [header, metadata] = await Promise.all([tiles.getHeader(), tiles.getMetadata() as Promise<Record<string, unknown>>]);
  const attribution = new DOMParser().parseFromString(String(metadata.attribution ?? ""), "text/html").body.textContent ?? "";
  onAttribution(attribution);
  const isVector = header.tileType === 1;
  const source = { type: isVector ? "vector" : "raster", url: `pmtiles://${url}`, ...(isVector ? {} : { tileSize: 256 }) };
  const layers: unknown[] = [{ id: "ground", type: "background", paint: { "background-color": dark ? "#10161d" : "#f4f3ef" } }];
  if (!isVector) layers.push({ id: "tiles", type: "raster", source: "tiles", paint: { "raster-saturation": -0.6, "raster-opacity": dark ? 0.5 : 0.8 } });
  const names = isVector ? ((metadata.vector_layers as { id: string }[] | undefined) ?? []).map((layer) => layer.id) : [];
  const water = /water|ocean|river/i;
  const building = /build/i;
  const road = /road|transport|street|highway/i;
  const place = /place|label|poi|address|boundar|mask/i;
  const drawn = names.filter((name) => !place.test(name)).sort((a, b) => rank(a) - rank(b));
  function rank(name: string): number {
    return water.test(name) ? 1 : road.test(name) ? 2 : building.test(name) ? 3 : 0;
  }
  for (const name of drawn) {
    const fill = water.test(name) ? (dark ? "#16232f" : "#cfdde6") : building.test(name) ? (dark ? "#1d242c" : "#e3e0da") : dark ? "#141b22" : "#edece6";
    layers.push({ id: `${name}-area`, type: "fill", source: "tiles", "source-layer": name, filter: ["==", ["geometry-type"], "Polygon"], paint: { "fill-color": fill } });
    const width = road.test(name) ? ["interpolate", ["exponential", 1.6], ["zoom"], 10, 0.5, 16, 4, 20, 30] : 1;
    layers.push({ id: `${name}-line`, type: "line", source: "tiles", "source-layer": name, filter: ["==", ["geometry-type"], "LineString"], paint: { "line-color": road.test(name) ? (dark ? "#2a333d" : "#ffffff") : dark ? "#202830" : "#dcdad2", "line-width": width } });
  }
  return { version: 8, sources: { tiles: source }, layers } as StyleSpecification;
}
