// Copies what package.json lists under "vendor" out of node_modules into vendor/. `make site` runs it after `npm ci`.
import { cpSync, readFileSync, renameSync, rmSync, writeFileSync } from 'node:fs';

const { dependencies, vendor } = JSON.parse(readFileSync('package.json', 'utf8'));
rmSync('vendor.part', { recursive: true, force: true });
for (const [to, from] of Object.entries(vendor)) cpSync(`node_modules/${from}`, `vendor.part/${to}`);
const versions = Object.entries(dependencies).map(([name, version]) => `${name} ${version}\n`);
writeFileSync('vendor.part/VERSIONS', versions.join(''));
rmSync('vendor', { recursive: true, force: true });
renameSync('vendor.part', 'vendor');
