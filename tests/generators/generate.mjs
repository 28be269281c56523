// Write what code generators make of an AsyncAPI document: node generate.mjs DOCUMENT FOLDER
// FOLDER/go and FOLDER/modelina by modelina with the options that its command line has, FOLDER/payloads.ts by
// json-schema-to-typescript, FOLDER/diagnostics.json by the parser of the AsyncAPI Initiative.

import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const tools = createRequire(join(process.cwd(), "package.json")); // where `npm ci` has put them
const { GoFileGenerator, GO_COMMON_PRESET, TypeScriptFileGenerator } = tools("@asyncapi/modelina");
const { Parser } = tools("@asyncapi/parser");
const { compile } = tools("json-schema-to-typescript");

const [path, folder] = process.argv.slice(2);
const text = readFileSync(path, "utf8");

const { diagnostics } = await new Parser().parse(text);
writeFileSync(join(folder, "diagnostics.json"), JSON.stringify(diagnostics));

mkdirSync(join(folder, "go"));
const forGo = new GoFileGenerator({ presets: [{ preset: GO_COMMON_PRESET, options: { addJsonTag: true } }] });
await forGo.generateToFiles(JSON.parse(text), join(folder, "go"), { packageName: "messages" });

mkdirSync(join(folder, "modelina"));
const forTypeScript = new TypeScriptFileGenerator({
  modelType: "interface",
  enumType: "union",
  mapType: "record",
  rawPropertyNames: true,
});
await forTypeScript.generateToFiles(JSON.parse(text), join(folder, "modelina"), { exportType: "named" });

const { components } = JSON.parse(text);
const payloads = Object.values(components.messages).map((message) => message.payload);
const types = await compile({ title: "Payload", anyOf: payloads, components }, "Payload", { format: false });
writeFileSync(join(folder, "payloads.ts"), types);
