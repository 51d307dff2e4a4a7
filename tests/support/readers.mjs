// Opens a file with a package that knows nothing of chebsplat. Arguments: package, file, what to write, node_modules.
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [reader, source, target, packages] = process.argv.slice(2);
const load = (path) => import(pathToFileURL(`${packages}/${path}`).href);

async function spark() {
  // The viewer's own decoder, which it keeps to itself; what it decoded is written as SPZ, with positions kept to 2^-12.
  // (Its exported transcodeSpz also turns the harmonics, and fails where a file has fewer than three bands.)
  const folder = `${packages}/@sparkjsdev/spark/dist`;
  const text = readFileSync(`${folder}/spark.module.js`, "utf8");
  writeFileSync(`${folder}/spark.decoder.mjs`, `${text}\nexport { decode_to_gsplatarray as decode };\n`);
  const { decode, getSplatFileType } = await load("@sparkjsdev/spark/dist/spark.decoder.mjs");
  const bytes = new Uint8Array(readFileSync(source));
  for (let tries = 0; ; tries++) {
    try {
      const decoder = decode(getSplatFileType(bytes), source);
      decoder.push(bytes);
      const splats = decoder.finish();
      return splats.encode_to_spz(splats.maxShDegree, 12);
    } catch (error) {
      if (tries === 400 || !String(error).includes("__wbindgen")) throw error;
      await new Promise((resolve) => setTimeout(resolve, 50)); // its wasm is still being compiled
    }
  }
}

async function zarrita() {
  const { open, get } = await load("zarrita/dist/src/index.js");
  const read = async (key) => {
    try {
      return new Uint8Array(readFileSync(source + key));
    } catch {
      return undefined;
    }
  };
  const { data } = await get(await open.v3({ get: read }, { kind: "array" }));
  return Buffer.from(data.buffer, data.byteOffset, data.byteLength);
}

writeFileSync(target, await { spark, zarrita }[reader]());
