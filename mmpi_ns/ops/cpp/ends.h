// When a ray ends, and where its depth lies. C++ and GLSL both read this file: the page's shader has it at its head
// (export/web.py), and Python reads its numbers (ops/ends.py).
const float OPAQUE = 1e-5;       // an exact ray is over where less light is left, and less than a kept sample weighs
const float OPAQUE_BAKED = 1e-2; // a baked ray is over where less light is left, which then counts as none
const float NEGLIGIBLE = 1e-4;   // samples of less optical depth get an equal share of blending without a lookup
const float NEAREST_ZERO = 1e-10; // inverse distances are no less where a distance is needed
const float FACING = 1e-6;       // a ray with a smaller cosine to an MPI's axis is parallel to its planes
const float HALF = 0.5;          // share of its weight behind which the depth of a ray lies

bool is_over(float light, float least) { return light <= least; }

// Whether the sample at which a ray has gathered so much of its weight is its depth: the first one that is.
bool is_depth(float gathered, float mass) { return gathered >= HALF * mass; }
