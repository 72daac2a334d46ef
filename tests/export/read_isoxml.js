// Task data as the library isoxml-js reads it: node read_isoxml.js FOLDER -> JSON; needs NODE_PATH with isoxml in it.
const fs = require("fs");
const path = require("path");
const { ISOXMLManager } = require("isoxml");
const JSZip = require("jszip");

(async () => {
  const zip = new JSZip();
  for (const name of fs.readdirSync(process.argv[2])) {
    zip.file(`TASKDATA/${name}`, fs.readFileSync(path.join(process.argv[2], name)));
  }
  const manager = new ISOXMLManager();
  await manager.parseISOXMLFile(await zip.generateAsync({ type: "uint8array" }), "application/zip");
  const log = manager.rootElement.attributes.Task[0].attributes.TimeLog[0];
  const { timeLogs, valuesInfo } = log.parseBinaryFile();
  console.log(JSON.stringify({ warnings: [...manager.getWarnings(), ...log.parsingErrors], timeLogs, valuesInfo }));
})();
