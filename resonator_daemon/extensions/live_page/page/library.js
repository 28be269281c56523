// Recordings of the server's directory: listed, opened, compared and closed.

import { bytes, make, setText } from "./text.js";

export class Library {
  #opened = null; // names, null before anything was opened here

  constructor(root, connection, announce) {
    this.root = root;
    this.connection = connection;
    this.announce = announce;
    this.details = root.querySelector("details");
    this.list = root.querySelector("ul");
    this.sources = [];
    this.details.addEventListener("toggle", () => this.details.open && this.#refresh());
    root.querySelector(".refresh").addEventListener("click", () => this.#refresh());
    root.querySelector(".close").addEventListener("click", () => this.#open([], "Recordings closed"));
  }

  /** Name of the directory, null where none is served; and the recordings that are shown. */
  describe(directory, sources) {
    const isFirst = this.root.hidden && directory !== null && !sources.length;
    this.root.hidden = directory === null;
    setText(this.root.querySelector(".directory"), directory ?? "");
    this.sources = sources.filter(({ source }) => source !== "live");
    this.root.querySelector(".close").disabled = !this.sources.length;
    for (const button of this.list.querySelectorAll(".compare")) button.disabled = !this.sources.length;
    if (isFirst) this.details.open = true; // there is nothing else to see
  }

  /** Open the same again after an outage of the connection: the server closes what a browser had open. */
  reopen() {
    if (this.#opened !== null) this.connection.request({ open: { names: this.#opened } });
  }

  async #refresh() {
    const answer = await this.connection.request({ recordings: {} });
    const recordings = Array.isArray(answer.recordings) ? answer.recordings : [];
    const omitted = answer.omitted > 0 ? `The newest ${recordings.length} are listed; ${answer.omitted} older ones are omitted.` : "";
    const found = recordings.length ? omitted : "The directory has no recordings (*.mcap).";
    setText(this.root.querySelector("output"), answer.ok ? found : `Refused: ${answer.error?.message ?? "no reason given"}`);
    this.list.replaceChildren(...recordings.map((recording) => this.#row(recording)));
  }

  #row({ name, bytes: size, modified_s }) {
    const row = make("li");
    const about = make("span", "about", `${new Date(1000 * modified_s).toLocaleString([], { dateStyle: "short", timeStyle: "short", hour12: false })}, ${bytes(size)}`);
    const open = make("button", "open", "Open");
    const compare = make("button", "compare", "Compare");
    open.type = compare.type = "button";
    open.setAttribute("aria-label", `Open ${name}`);
    compare.setAttribute("aria-label", `Compare with ${name}`);
    compare.title = "Shows it next to recording A; both begin together";
    compare.disabled = !this.sources.length;
    open.addEventListener("click", () => this.#open([name], `Opened ${name}`));
    compare.addEventListener("click", () => this.#open([this.sources[0].file, name], `Compared with ${name}`));
    row.append(make("span", "name", name), about, open, compare);
    return row;
  }

  async #open(names, done) {
    const answer = await this.connection.request({ open: { names } });
    const text = answer.ok ? done : `Refused: ${answer.error?.message ?? "no reason given"}`;
    this.announce(text);
    setText(this.root.querySelector("output"), answer.ok ? "" : text);
    if (!answer.ok) return;
    this.#opened = names;
    if (!names.length) this.details.querySelector("summary").focus(); // its button is disabled now
  }
}
