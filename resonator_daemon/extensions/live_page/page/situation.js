// Situation of a plate, by its retained states.

import { clockTime, words } from "./text.js";

// code: [title, icon, kind]; the icon is a symbol of index.html, the kind a colour.
const SITUATIONS = {
  well: ["Working", "well", "good"],
  never_started: ["Never started", "never", "off"],
  clean_stop: ["Stopped", "stop", "off"],
  crash: ["Daemon ended without notice", "crash", "bad"],
  broker_restarted: ["Working; connected to the broker again", "broker", "note"],
  cable_out: ["No connection to the board", "cable", "bad"],
  computer_busy: ["The computer is busy", "hung", "warn"],
  board_hung: ["The board sends nothing", "hung", "bad"],
  board_rebooted: ["Working; the board restarted", "reboot", "note"],
  sensor_drifting: ["The sensor drifts", "drift", "warn"],
  recording_over: ["End of the recording", "stop", "off"],
  no_broker: ["Not known", "broker", "warn"],
  other: ["Not ready", "other", "warn"],
};

function code({ daemon, link, sensor }) {
  if (!daemon) return "never_started";
  if (daemon.state === "offline") return { stopped: "clean_stop", recording_over: "recording_over" }[daemon.reasonCode] ?? "crash";
  if (daemon.state === "online") {
    if (link?.reasonCode === "recording_over") return "recording_over";
    if (link?.reasonCode === "computer_busy") return "computer_busy";
    if (["lost", "waiting"].includes(link?.state)) return "cable_out";
    if (link?.state === "stalled") return "board_hung";
    if (link?.state === "online" && sensor?.state === "drifting") return "sensor_drifting";
    if (link?.state === "online" && sensor?.state === "online") {
      if (link.boots > 1) return "board_rebooted";
      return daemon.connections > 1 ? "broker_restarted" : "well";
    }
  }
  return "other";
}

function detail(found, { daemon, link, sensor }) {
  const { outage } = link ?? {};
  switch (found) {
    case "well":
      return sensor.reason && sensor.reason !== "measuring" ? sensor.reason : "Measures and publishes; nothing is wrong.";
    case "never_started":
      return "No daemon has published under this name. Start one: resonatord run.";
    case "clean_stop":
      return `${daemon.reason || "Ended in order"}, at ${clockTime(daemon.since)}. Start it again: resonatord run.`;
    case "crash":
      return "The connection to the broker broke: the daemon crashed, was killed, or its computer left the network.";
    case "broker_restarted":
      return `Connection ${daemon.connections} to the broker, since ${clockTime(daemon.connected)}. The broker or the network had failed.`;
    case "recording_over":
      return (daemon.state === "offline" ? daemon : link).reason;
    case "cable_out":
    case "board_hung":
      return link.reason;
    case "computer_busy":
      return `${link.reason}. Give the daemon precedence (CPUWeight, nice), decode elsewhere, or lower the frame rate.`;
    case "board_rebooted":
      return `${outage ? `Measures again since ${clockTime(outage.end)}. Before: ${outage.reason}. ` : ""}This is boot ${link.boots}.`;
    case "sensor_drifting":
      return sensor.reason;
    case "no_broker":
      return "The page has no connection to the broker. It shows the last values.";
    default: {
      const parts = Object.entries({ daemon, link, sensor }).filter(([, state]) => state?.state !== "online");
      return parts.map(([part, state]) => `${part}: ${state ? state.reason || words(state.state) : "unknown"}`).join("; ");
    }
  }
}

/** Situation of a plate from its states by part: {code, title, icon, kind, detail}. Recordings lack that of the daemon. */
export function situation({ daemon, link, sensor }, isLive, hasBroker) {
  const states = { daemon: daemon ?? (isLive ? undefined : { state: "online" }), link, sensor };
  const found = isLive && !hasBroker ? "no_broker" : code(states);
  const [title, icon, kind] = SITUATIONS[found];
  return { code: found, title, icon, kind, detail: detail(found, states) };
}
