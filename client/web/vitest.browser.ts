/** The page in a real browser against a real server; see tests/browser. */
import { defineConfig } from 'vitest/config';

export default defineConfig({
  test: {
    include: ['tests/browser/**/*.test.ts'],
    // Far beyond what anything here takes, so that a hang is a failure and a slow machine is not.
    testTimeout: 90_000,
    hookTimeout: 120_000,
    expect: { poll: { timeout: 30_000 } },
    // One server, one browser, one story: later tests go on where earlier ones ended.
    fileParallelism: false,
    bail: 1,
  },
});
