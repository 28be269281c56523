// Situation of a plate: the worst condition of page, broker, daemon, link and sensor, as one headline.

import { clockTime, words } from "./text.js";

// code: [title, icon, kind]; the icon is a symbol of index.html, the kind a colour.
const SITUATIONS = {
  well: ["Working", "well", "good"],
  never_started: ["Never started", "never", "off"],
  clean_stop: ["The daemon is stopped", "stop", "off"],
  crash: ["The daemon ended without notice", "crash", "bad"],
  broker_restarted: ["Working; connected to the broker again", "broker", "note"],
  cable_out: ["No connection to the board", "cable", "bad"],
  computer_busy: ["The computer is busy", "hung", "warn"],
  board_hung: ["The board sends nothing", "hung", "bad"],
  board_rebooted: ["Working; the board restarted", "reboot", "note"],
  sensor_stalled: ["The sensor has no results", "hung", "bad"],
  sensor_drifting: ["The sensor drifts", "drift", "warn"],
  recording_over: ["End of the recording", "stop", "off"],
  sensor_suspect: ["Sites are suspect", "drift", "warn"],
  no_broker: ["No connection to the MQTT broker", "broker", "bad"],
  no_server: ["No connection to the page's server", "cable", "bad"],
  other_version: ["Messages of another version", "other", "warn"],
  other: ["Not ready", "other", "warn"],
};

// Which part's state a situation began with.
const SINCE = { clean_stop: "daemon", crash: "daemon", cable_out: "link", board_hung: "link", sensor_stalled: "sensor", sensor_drifting: "sensor", no_broker: "broker", no_server: "server" };

function code({ daemon, link, sensor }) {
  if (!daemon) return "never_started";
  if (daemon.state === "offline") return { stopped: "clean_stop", recording_over: "recording_over" }[daemon.reasonCode] ?? "crash";
  if (daemon.state === "online") {
    if (link?.reasonCode === "recording_over") return "recording_over";
    if (link?.state === "online" && sensor?.state === "stalled") return "sensor_stalled";
    if (link?.reasonCode === "computer_busy") return "computer_busy";
    if (["lost", "waiting"].includes(link?.state)) return "cable_out";
    if (link?.state === "stalled") return "board_hung";
    if (link?.state === "online" && sensor?.state === "drifting") return "sensor_drifting";
    if (link?.state === "online" && sensor?.state === "online") {
      if (sensor.reasonCode === "sensor_suspect") return "sensor_suspect";
      if (link.boots > 1) return "board_rebooted";
      return daemon.connections > 1 ? "broker_restarted" : "well";
    }
  }
  return "other";
}

function detail(found, { daemon, link, sensor, broker }, version) {
  const { outage } = link ?? {};
  switch (found) {
    case "well":
      return sensor.reason && sensor.reason !== "measuring" ? sensor.reason : "Measures and publishes; nothing is wrong.";
    case "never_started":
      return "No daemon has published under this name. Start one: resonatord run.";
    case "clean_stop":
      return `${daemon.reason && daemon.reason !== "stopped" ? `${daemon.reason}. ` : ""}Start it again: resonatord run.`;
    case "crash":
      return "The connection to the broker broke: the daemon crashed, was killed, or its computer left the network.";
    case "broker_restarted":
      return `Connection ${daemon.connections} to the broker, since ${clockTime(daemon.connected)}. The broker or the network had failed.`;
    case "recording_over":
      return (daemon.state === "offline" ? daemon : link).reason;
    case "cable_out":
    case "board_hung":
      return link.reason;
    case "sensor_stalled":
      return [sensor.reason, link.reasonCode === "computer_busy" && link.reason].filter(Boolean).join("; ");
    case "computer_busy":
      return `${link.reason}. Give the daemon precedence (CPUWeight, nice), decode elsewhere, or lower the frame rate.`;
    case "board_rebooted":
      return `${outage ? `Measures again since ${clockTime(outage.end)}. Before: ${outage.reason}. ` : ""}This is boot ${link.boots}.`;
    case "sensor_drifting":
    case "sensor_suspect":
      return sensor.reason;
    case "no_broker":
      return `${broker.reason || broker.reason_code || "No reason given"}; trying again.`;
    case "no_server":
      return "resonatord view ended, or the network failed; trying again.";
    case "other_version":
      return `Messages of version ${version} may be shown wrongly: this page reads version 2.`;
    default: {
      const parts = Object.entries({ daemon, link, sensor }).filter(([, state]) => state?.state !== "online");
      return parts.map(([part, state]) => `${part}: ${state ? state.reason || words(state.state) : "unknown"}`).join("; ");
    }
  }
}

/** Situation of a model on the page: {code, title, icon, kind, detail, since}. Recordings lack the state of the daemon. */
export function situation({ states, source, info }, { link, broker, isOpen, hasBroker }) {
  const isLive = source === "live";
  const parts = { ...states, daemon: states.daemon ?? (isLive ? undefined : { state: "online" }), server: link, broker };
  let found = code(parts);
  if (info?.supported === false && SITUATIONS[found][2] !== "bad") found = "other_version";
  if (isLive && !hasBroker) found = "no_broker";
  if (!isOpen) found = "no_server";
  const [title, icon, kind] = SITUATIONS[found];
  return { code: found, title, icon, kind, detail: detail(found, parts, info?.version), since: parts[SINCE[found]]?.since };
}
