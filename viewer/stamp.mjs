// Record what the page was built from, so that a test without Node.js knows whether it is up to date.
import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";

const listed = ["src", "public"].flatMap((folder) =>
  readdirSync(folder, { recursive: true, withFileTypes: true })
    .filter((entry) => entry.isFile())
    .map((entry) => `${entry.parentPath}/${entry.name}`),
);
const files = [...listed, "index.html", "package.json", "package-lock.json", "vite.config.ts", "tsconfig.json"].sort();
const digest = createHash("sha256");
for (const name of files) digest.update(`${name}\0`).update(readFileSync(name)).update("\0");
writeFileSync("../python/valuemap/viewer/page/built_from.txt", `${digest.digest("hex")}\n`);
