/** From metres east and north of an anchor to latitude and longitude on WGS84. */

const A = 6378137;
const F = 1 / 298.257223563;
const E2 = F * (2 - F);

export interface Anchor {
  lat: number;
  lon: number;
  height: number;
}

/** Where a point of the anchor's horizontal plane is, and by how many degrees north there is turned from the anchor's. */
export function geographic(anchor: Anchor, east: number, north: number): { lat: number; lon: number; convergence: number } {
  const lat = (anchor.lat * Math.PI) / 180;
  const lon = (anchor.lon * Math.PI) / 180;
  const [sinLat, cosLat, sinLon, cosLon] = [Math.sin(lat), Math.cos(lat), Math.sin(lon), Math.cos(lon)];
  const radius = A / Math.sqrt(1 - E2 * sinLat * sinLat);
  const x = (radius + anchor.height) * cosLat * cosLon - sinLon * east - sinLat * cosLon * north;
  const y = (radius + anchor.height) * cosLat * sinLon + cosLon * east - sinLat * sinLon * north;
  const z = (radius * (1 - E2) + anchor.height) * sinLat + cosLat * north;
  const p = Math.hypot(x, y);
  // A few rounds of the fixed point are exact to far below a millimetre near the ground.
  let found = Math.atan2(z, p * (1 - E2));
  for (let round = 0; round < 5; round++) {
    const n = A / Math.sqrt(1 - E2 * Math.sin(found) ** 2);
    found = Math.atan2(z + E2 * n * Math.sin(found), p);
  }
  const there = Math.atan2(y, x);
  return {
    lat: (found * 180) / Math.PI,
    lon: (there * 180) / Math.PI,
    convergence: (((there - lon) * 180) / Math.PI) * Math.sin(found),
  };
}
