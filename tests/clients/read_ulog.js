// Reads a ULog with @foxglove/ulog and prints all that it holds as one JSON document. NaN becomes null.
const { MessageType, ULog } = require("@foxglove/ulog");
const { FileReader } = require("@foxglove/ulog/node");

const plain = (key, value) => {
  if (typeof value === "bigint") return value.toString();
  if (ArrayBuffer.isView(value)) return Array.from(value);
  if (value instanceof Map) return Object.fromEntries(value);
  return value;
};

(async () => {
  const log = new ULog(new FileReader(process.argv[2]));
  await log.open();
  const topics = {}, texts = [];
  for await (const message of log.readMessages()) {
    if (message.type === MessageType.Data) {
      const name = log.subscriptions.get(message.msgId).name;
      (topics[name] ??= []).push(message.value);
    } else if (message.type === MessageType.Log) {
      texts.push([message.logLevel, message.timestamp, message.message]);
    }
  }
  const { information, parameters } = log.header;
  console.log(JSON.stringify({ topics, texts, information, parameters }, plain));
})();
