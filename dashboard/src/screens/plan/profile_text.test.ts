import { describe, expect, test } from "vitest";
import { changedProfile, keptAs, nameOf, renamed, UNCHANGED } from "./profile_text";

const PROFILE = `name = "bar"
title = "name = \\"x\\""

[[sensors]]
name = "left"
position = ["-200 mm", "0 mm", "10 mm"]
aim = ["0 mm", "0 mm", "1500 mm"]

[[sensors]]
name = "right"
position = ["200 mm", "0 mm", "10 mm"]

[optics.main]
position = ["1 mm", "1 mm", "1 mm"]

[rates]
exposure = "100 us"

[volume]
centre = ["0 mm", "0 mm", "1500 mm"]
size = ["600 mm", "600 mm", "600 mm"]
`;

describe("changed profile", () => {
  test("is the same where nothing is changed", () => expect(changedProfile(PROFILE, UNCHANGED)).toBe(PROFILE));
  test("is the same to the letter, however its numbers are written", () => {
    const toml = PROFILE.replace('"1500 mm"]', '"1500.0 mm"]').replace('"100 us"', '"100  us"');
    expect(changedProfile(toml, UNCHANGED)).toBe(toml);
  });
  test("has sensors farther apart, about their middle, and no other position moved", () => {
    const changed = changedProfile(PROFILE, { ...UNCHANGED, baseline: 1.5 });
    expect(changed).toContain('position = ["-300 mm", "0 mm", "10 mm"]');
    expect(changed).toContain('position = ["300 mm", "0 mm", "10 mm"]');
    expect(changed).toContain('position = ["1 mm", "1 mm", "1 mm"]');
  });
  test("has the volume farther away, and sensors aim at it", () => {
    const changed = changedProfile(PROFILE, { ...UNCHANGED, distance: 2 });
    expect(changed).toContain('centre = ["0 mm", "0 mm", "3000 mm"]');
    expect(changed).toContain('aim = ["0 mm", "0 mm", "3000 mm"]');
  });
  test("has another volume and exposure", () => {
    const changed = changedProfile(PROFILE, { ...UNCHANGED, volume: 0.5, exposure: 3 });
    expect(changed).toContain('size = ["300 mm", "300 mm", "300 mm"]');
    expect(changed).toContain('exposure = "300 us"');
  });
  test.each([
    ["mixed units", PROFILE.replace('"200 mm"', '"0.2 m"')],
    ["no volume", PROFILE.split("[volume]")[0] as string],
    ["numbers without a unit", PROFILE.replace('["-200 mm", "0 mm", "10 mm"]', "[-200, 0, 10]")],
    ["nothing", ""],
  ])("with %s is left to be edited by hand", (_, toml) => {
    expect(changedProfile(toml, { ...UNCHANGED, baseline: 2 })).toBeNull();
  });
});

test("a profile is renamed, and nothing else of it", () => {
  const changed = renamed(PROFILE, "wide");
  expect(nameOf(changed)).toBe("wide");
  expect(changed).toContain('name = "left"');
  expect(nameOf(renamed(PROFILE, "a$&b"))).toBe("a$&b");
});

test("a text is kept where it is stored, under whatever name, and nothing of it was changed since", () => {
  const stored = [
    { name: "wide", toml: renamed(PROFILE, "wide") },
    { name: "bar", toml: PROFILE },
  ];
  expect(keptAs(PROFILE, stored.slice(1))).toBe("bar");
  expect(keptAs(PROFILE, stored)).toBe("wide");
  expect(keptAs(PROFILE.replace("100 us", "90 us"), stored)).toBeNull();
  expect(keptAs(PROFILE, [])).toBeNull();
});
