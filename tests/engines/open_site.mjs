// node open_site.mjs ADDRESS prints, as JSON, what the page at an address shows: each object with its self-test, and the lights.
import { withPage } from "./browser.mjs";

const found = await withPage(async (page) => {
  await page.goto(process.argv[2]);
  await page.evaluate("prtbake.ready");
  const read = () => page.evaluate(() => ({
    name: document.getElementById("name").textContent, check: document.getElementById("check").textContent, selftest: window.prtbake.selftest,
  }));
  const objects = [await read()];
  if (await page.$("#next:not([hidden])")) {
    await page.click("#next");
    await page.waitForFunction((name) => document.getElementById("name").textContent !== name, {}, objects[0].name);
    objects.push(await read());
  }
  return { objects, lights: await page.$$eval("#light option", (options) => options.map((each) => each.textContent)) };
});
process.stdout.write(JSON.stringify(found) + "\n");
