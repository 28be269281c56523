// WebSocket to the page's server: opened again after an outage, one callback per kind of message, numbered requests.

const RETRY_MS = [500, 1000, 2000, 4000];
const TEXT = new TextDecoder();

export class Connection {
  #socket = null;
  #attempts = 0;
  #number = 0;
  #waiting = new Map();

  /**
   * handlers: payload(source, plate, path, bytes), message(key, content), and state("connecting" | "open" | "closed").
   */
  constructor(url, handlers) {
    this.url = url;
    this.handlers = handlers;
    this.#open();
  }

  #open() {
    this.handlers.state("connecting");
    const socket = new WebSocket(this.url);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#attempts = 0;
      this.handlers.state("open");
    };
    socket.onmessage = ({ data }) => (typeof data === "string" ? this.#text(data) : this.#binary(new Uint8Array(data)));
    socket.onclose = () => {
      for (const settle of this.#waiting.values()) settle(refusal("not_connected", "The connection to the server ended."));
      this.#waiting.clear();
      this.handlers.state("closed");
      setTimeout(() => this.#open(), RETRY_MS[Math.min(this.#attempts++, RETRY_MS.length - 1)]);
    };
  }

  #binary(bytes) {
    const end = 1 + bytes[0];
    const [source, plate, ...path] = TEXT.decode(bytes.subarray(1, end)).split("/");
    if (plate) this.handlers.payload(source, plate, path.join("/"), bytes.subarray(end));
  }

  #text(data) {
    let message;
    try {
      message = JSON.parse(data);
    } catch {
      return;
    }
    for (const [key, content] of Object.entries(message ?? {})) {
      if (key !== "answer") this.handlers.message(key, content ?? {});
      else {
        this.#waiting.get(content?.id)?.(content);
        this.#waiting.delete(content?.id);
      }
    }
  }

  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (this.isOpen) this.#socket.send(JSON.stringify(message));
  }

  /** Send a request and return its answer; an answer with an error where there is no connection. */
  request(message) {
    if (!this.isOpen) return Promise.resolve(refusal("not_connected", "There is no connection to the server."));
    const id = ++this.#number;
    return new Promise((settle) => {
      this.#waiting.set(id, settle);
      this.send({ id, ...message });
    });
  }
}

const refusal = (code, message) => ({ ok: false, error: { code, message } });
