// Between a browser and a server of this machine: a cable that can be pulled.

import { connect, createServer } from "node:net";

export function cable(from, to) {
  const sockets = new Set();
  const server = createServer((near) => {
    const far = connect(to, "127.0.0.1");
    for (const [socket, other] of [[near, far], [far, near]]) {
      sockets.add(socket);
      socket.on("error", () => {}).on("close", () => (sockets.delete(socket), other.destroy()));
      socket.pipe(other);
    }
  });
  server.listen(from, "127.0.0.1");
  return { pull: () => [...sockets].forEach((socket) => socket.destroy()), close: () => server.close() };
}
