/** Ellipses in true scale, all of them drawn by the GPU: circles that are squeezed and turned as they are placed. */

import { type ScatterplotLayerProps, ScatterplotLayer } from "@deck.gl/layers";

/** `getRadius` is the major half axis; the attribute `getShape` holds cosine and sine of its angle, and minor by major. */
export class EllipseLayer extends ScatterplotLayer<unknown, Record<string, unknown>> {
  static layerName = "EllipseLayer";
  static defaultProps = { getShape: { type: "accessor", value: [1, 0, 1] } } as never;

  getShaders() {
    const shaders = super.getShaders();
    return {
      ...shaders,
      inject: {
        "vs:#decl": "in vec3 instanceShapes;\n",
        "vs:DECKGL_FILTER_SIZE": `
          vec2 squeezed = vec2(size.x, size.y * instanceShapes.z);
          size.x = squeezed.x * instanceShapes.x - squeezed.y * instanceShapes.y;
          size.y = squeezed.x * instanceShapes.y + squeezed.y * instanceShapes.x;
        `,
        // The outline is as wide along the minor axis as along the major one: fwidth knows how far a pixel reaches.
        "fs:DECKGL_FILTER_COLOR": `
          float reach = length(geometry.uv);
          float pixel = max(fwidth(reach), 1e-6);
          float line = smoothstep(1.0 - 2.5 * pixel, 1.0 - 1.5 * pixel, reach);
          color.a *= mix(0.22, 1.0, line) * (1.0 - smoothstep(1.0 - pixel, 1.0, reach));
        `,
      },
    };
  }

  initializeState(): void {
    super.initializeState();
    this.getAttributeManager()!.addInstanced({
      instanceShapes: { size: 3, accessor: "getShape", defaultValue: [1, 0, 1] },
    });
  }
}

export type EllipseProps = ScatterplotLayerProps;
