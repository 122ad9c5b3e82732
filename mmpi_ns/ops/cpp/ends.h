// Termination and depth of a ray. C++ and GLSL both read this file: it stands at the head of the page's shader
// (export/web.py), and Python reads its numbers (ops/ends.py).
const float OPAQUE = 1e-5;       // transmittance at which an exact ray terminates, unless a kept sample may weigh less
const float OPAQUE_BAKED = 1e-2; // transmittance at which a baked ray terminates; the rest counts as none
const float NEGLIGIBLE = 1e-4;   // optical depth below which a sample gets an equal share of blending, without a lookup
const float NEAREST_ZERO = 1e-10; // least inverse distance where a distance is needed
const float FACING = 1e-6;       // a ray with a smaller cosine to an MPI's axis is parallel to its planes
const float HALF = 0.5;          // share of its weight at which the depth of a ray lies

bool is_terminated(float transmittance, float least) { return transmittance <= least; }

// Whether a sample is the depth of its ray, given the weight gathered up to it; the first such sample is.
bool is_depth(float gathered, float mass) { return gathered >= HALF * mass; }
