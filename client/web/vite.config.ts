/** The page as the server embeds it: `dist`, committed, small files named by their contents. */
import { defineConfig } from 'vite';

/** A server to develop against: LUMISPHERE_SERVER=http://127.0.0.1:7443 npm run dev. */
const proxy = { '^/lumisphere\\.v1alpha1\\.': process.env['LUMISPHERE_SERVER'] ?? 'http://127.0.0.1:7443' };

export default defineConfig({
  base: './',
  build: {
    target: 'es2022',
    // Every file is a file of its own: the page's policy allows nothing inline.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
  },
  server: { proxy },
  preview: { proxy },
});
