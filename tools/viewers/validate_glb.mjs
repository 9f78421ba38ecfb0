// node validate_glb.mjs FILE...: what the Khronos validator says, as one JSON object; exit code 1 with errors or warnings.
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const reports = {};
let clean = true;
for (const path of process.argv.slice(2)) {
  const report = await validator.validateBytes(new Uint8Array(await readFile(path)), { maxIssues: 100 });
  const { numErrors, numWarnings, numInfos, messages } = report.issues;
  reports[path] = { errors: numErrors, warnings: numWarnings, infos: numInfos, messages };
  clean &&= numErrors === 0 && numWarnings === 0;
}
console.log(JSON.stringify(reports, null, 2));
process.exit(clean ? 0 : 1);
