import { beforeEach, expect, test, vi } from "vitest";
import { copyText } from "./clipboard";

class FakeElement {
  value = "";
  focused = 0;
  append = vi.fn();
  remove = vi.fn();
  select = vi.fn();
  focus(): void {
    this.focused += 1;
  }
}

const button = new FakeElement();
let field: FakeElement;
const body = new FakeElement();
let execute: () => boolean;

beforeEach(() => {
  field = new FakeElement();
  vi.stubGlobal("HTMLElement", FakeElement);
  vi.stubGlobal("document", { activeElement: button, body, createElement: () => field, execCommand: () => execute() });
});

test("the browser's clipboard is used where there is one", async () => {
  const writeText = vi.fn(async () => undefined);
  vi.stubGlobal("navigator", { clipboard: { writeText } });
  expect(await copyText("1, 2")).toBe(true);
  expect(writeText).toHaveBeenCalledWith("1, 2");
  expect(body.append).not.toHaveBeenCalled();
});

test.each([
  ["without one", {}],
  ["where it is not allowed", { clipboard: { writeText: () => Promise.reject(new Error("not allowed")) } }],
])("%s the text is selected and copied, and the focus goes back", async (_name, navigator) => {
  vi.stubGlobal("navigator", navigator);
  const before = button.focused;
  let copied = "";
  execute = () => {
    copied = field.value;
    return true;
  };
  expect(await copyText("1, 2")).toBe(true);
  expect(copied).toBe("1, 2");
  expect(field.select).toHaveBeenCalled();
  expect(field.remove).toHaveBeenCalled();
  expect(button.focused).toBe(before + 1);
});

test("what cannot be copied at all is told, not thrown", async () => {
  vi.stubGlobal("navigator", {});
  execute = () => {
    throw new Error("no");
  };
  expect(await copyText("1, 2")).toBe(false);
  expect(field.remove).toHaveBeenCalled();
});
