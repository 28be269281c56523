// Read a message of `forces` whose force is null, by the types of both generators.

import type { Forces } from "./payloads";
import type { Forces as ForcesOfModelina } from "./modelina/Forces";
import { overload } from "./examples";

const text = JSON.stringify(overload);
const forces: Forces = JSON.parse(text);
const same: ForcesOfModelina = JSON.parse(text);
const force: number | null | undefined = forces.sites[0].force_newton;
const forceOfModelina: number | null | undefined = same.sites[0].force_newton;
if (force !== null || forceOfModelina !== null || forces.sites[0].status !== "overload") {
  throw new Error(`force ${force}, ${forceOfModelina}`);
}
// @ts-expect-error: what may be null is no number before it has been asked for
const plain: number = forces.sites[0].force_newton;
// @ts-expect-error: nor is it in the other
const plainOfModelina: number = same.sites[0].force_newton;
// @ts-expect-error: no such word
const unheard: Forces["status"] = "fine";
