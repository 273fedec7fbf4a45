import { defineConfig } from "vitest/config";

/** A server of one's own, to try the page while it is written. */
const SERVER = process.env["LUMILINE_SERVER"] ?? "http://127.0.0.1:8000";
const PROXY = { "/api": { target: SERVER, ws: true }, "/readyz": { target: SERVER } };

export default defineConfig({
  // The page lies at / and its files at /dashboard/.
  base: "./",
  oxc: { jsx: { runtime: "automatic", importSource: "preact" } },
  build: {
    assetsDir: "dashboard",
    // The server's policy allows neither data: addresses nor scripts inside the page.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    target: "es2022",
    rolldownOptions: {
      output: {
        codeSplitting: { groups: [{ name: "three", test: /node_modules\/three/ }] },
      },
    },
  },
  server: { proxy: PROXY },
  test: { environment: "node", include: ["src/**/*.test.ts"] },
});
