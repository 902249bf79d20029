// Reads a recording as the Foxglove app does and prints what it found as JSON.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});

const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
  decoders.set(channel.id, { topic: channel.topic, type: schema.name, reader: new MessageReader(definition) });
}

const topics = {};
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const { topic, type, reader: decoder } = decoders.get(message.channelId);
  const found = (topics[topic] ??= { type, messages: 0 });
  found.last = decoder.readMessage(message.data);
  found.messages += 1;
}

const metadata = {};
for await (const record of reader.readMetadata()) {
  metadata[record.name] = Object.fromEntries(record.metadata);
}
const attachments = {};
for await (const record of reader.readAttachments({ validateCrcs: true })) {
  attachments[record.name] = record.data.byteLength;
}
await file.close();

// BigInt and typed arrays have no JSON of their own.
const plain = (_key, value) =>
  typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value) : value;
console.log(JSON.stringify({ profile: reader.header.profile, topics, metadata, attachments }, plain));
