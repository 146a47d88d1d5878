import { defineConfig } from "vite";

// The page is served by valuemap's own server from the root, under a policy that allows nothing inline.
export default defineConfig({
  base: "/",
  build: {
    outDir: "../python/valuemap/viewer/page",
    emptyOutDir: true,
    target: "es2022",
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 3000,
  },
  worker: { format: "es" },
});
