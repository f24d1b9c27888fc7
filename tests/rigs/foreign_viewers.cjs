// Foxglove's own code as a reader: node foreign_viewers.cjs file PATH | live URL. One JSON object on stdout: channel -> number of messages.
// Every message of a type of Foxglove's must keep to Foxglove's published JSON Schema.
const fs = require("node:fs");
const Ajv = require("ajv").default;
const published = require("@foxglove/schemas/jsonschema");

const ajv = new Ajv({ strict: false });
const checks = new Map();
for (const schema of Object.values(published)) {
  checks.set(schema.title, ajv.compile(schema));
}

const counts = {};
const wrong = [];
const take = (topic, schemaName, data) => {
  const message = JSON.parse(new TextDecoder().decode(data));
  counts[topic] = (counts[topic] ?? 0) + 1;
  if (schemaName.startsWith("foxglove.")) {
    const check = checks.get(schemaName);
    if (check == undefined || !check(message)) {
      wrong.push([topic, schemaName, check?.errors?.[0] ?? "is not published"]);
    }
  }
};

async function readFile(path) {
  const { McapIndexedReader } = require("@mcap/core");
  const fzstd = require("fzstd");
  const data = fs.readFileSync(path);
  const readable = {
    size: async () => BigInt(data.byteLength),
    read: async (offset, length) => new Uint8Array(data.subarray(Number(offset), Number(offset + length))),
  };
  const decompressHandlers = { zstd: (buffer, size) => fzstd.decompress(buffer, new Uint8Array(Number(size))) };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  let last = 0n;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    if (message.logTime < last || message.logTime === 0n) {
      wrong.push(["log time", String(message.logTime), String(last)]);
    }
    last = message.logTime;
    const channel = reader.channelsById.get(message.channelId);
    take(channel.topic, reader.schemasById.get(channel.schemaId).name, message.data);
  }
}

async function watch(url, seconds) {
  const { FoxgloveClient } = require("@foxglove/ws-protocol");
  const { WebSocket } = require("ws");
  const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
  const subscribed = new Map();
  client.on("error", (error) => wrong.push(["error", String(error)]));
  client.on("advertise", (channels) => {
    for (const channel of channels) {
      JSON.parse(channel.schema);
      subscribed.set(client.subscribe(channel.id), channel);
    }
  });
  client.on("message", ({ subscriptionId, data }) => {
    const channel = subscribed.get(subscriptionId);
    take(channel.topic, channel.schemaName, data);
  });
  await new Promise((resolve) => setTimeout(resolve, seconds * 1000));
  client.close();
}

const [how, where, seconds] = process.argv.slice(2);
(how === "file" ? readFile(where) : watch(where, Number(seconds)))
  .catch((error) => wrong.push(["raised", String(error?.stack ?? error)]))
  .finally(() => {
    process.stdout.write(JSON.stringify({ counts, wrong: wrong.slice(0, 5) }), () => process.exit(0));
  });
