// The master control client of vda-5050-lib (VDA 5050 1.1 and 2.0): prints what it is told of the
// vehicles, a line of JSON each, until stdin ends. A line of stdin is what it sends a vehicle:
// {"topic": "order", "serialNumber": "r2d2", "object": {…}}, without the header.
//
//     node master.js '{"url": "mqtt://127.0.0.1:1883", "username": "fleet", "password": "…"}'
//
// It validates what it sends and receives against the schemas of 2.0; what is not valid is printed
// as `error`.
const { MasterControlClient, Topic } = require("vda-5050-lib");

const { createInterface } = require("readline");

const options = JSON.parse(process.argv[2]);
const manufacturer = options.manufacturer || "acme";
const say = (line) => process.stdout.write(JSON.stringify(line) + "\n");

const client = new MasterControlClient({
  interfaceName: options.interface || "uagv",
  vdaVersion: options.version || "2.0.0",
  transport: {
    brokerUrl: options.url,
    protocolVersion: options.protocol || "5.0",
    username: options.username,
    password: options.password,
  },
});

process.on("unhandledRejection", (error) => say({ error: String(error) }));
// The library tells of an invalid message on the console only.
for (const level of ["log", "info", "warn", "error"]) console[level] = (...told) => say({ error: told.join(" ") });

async function main() {
  client.trackAgvs((vehicle, state, timestamp) =>
    say({ vehicle: vehicle.serialNumber, state, timestamp }));
  await client.start();
  await client.subscribe(Topic.State, { manufacturer }, (state, vehicle) =>
    say({ vehicle: vehicle.serialNumber, order: state.orderId, headerId: state.headerId }));
  say({ ready: true });
}

main().catch((error) => { say({ error: String(error) }); process.exit(1); });
const input = createInterface({ input: process.stdin });
input.on("line", (line) => {
  const { topic, serialNumber, object } = JSON.parse(line);
  client.publish(topic, { manufacturer, serialNumber }, object).catch((error) => say({ error: String(error) }));
});
input.on("close", () => client.stop().finally(() => process.exit(0)));
