/** Columns of numbers as the server packs them (python/valuemap/viewer/columns.py), viewed without a copy. */

export type Numbers = Float32Array | Float64Array | Int32Array | Uint8Array;

interface Described {
  name: string;
  type: "Float32Array" | "Float64Array" | "Int32Array" | "Uint8Array";
  rows: number;
  width: number;
  offset: number;
}

const TYPES = { Float32Array, Float64Array, Int32Array, Uint8Array };

export class Columns {
  private readonly columns = new Map<string, Numbers>();
  private readonly rowsOf = new Map<string, number>();

  constructor(body: ArrayBuffer) {
    const length = new DataView(body).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, length))) as Described[];
    for (const { name, type, rows, width, offset } of header) {
      this.columns.set(name, new TYPES[type](body, offset, rows * width));
      this.rowsOf.set(name, rows);
    }
  }

  rows(name: string): number {
    return this.rowsOf.get(name) ?? 0;
  }

  has(name: string): boolean {
    return this.columns.has(name);
  }

  get<T extends Numbers = Float32Array>(name: string): T {
    const found = this.columns.get(name);
    if (!found) throw new Error(`there is no column ${name}`);
    return found as T;
  }
}
