// Weight of a training image at the surface of a ray: head of the page's shader (mmpi_show/web.py), whose numbers Python
// reads, too (rendering/details.py).
const float TURN = 0.01;        // angle of viewing directions below which weights hardly grow, radians
const float FADE = 0.3;         // angle at which a residual fades to a half, radians
const float SAME_DEPTH = 0.05;  // relative difference of inverse depths within which two images show one surface
const float SAME_PIXELS = 0.5;  // ... or displacement by their difference, pixels
const float STRENGTH = 1.1;     // above 1, because other views lack more than the training images
const float HERE = 0.25;        // share of a residual against the image being rendered, not against its own rendering
const float MIDDLE = 0.5;       // radiance subtracted from both, so that stored residuals stay small
const float LEAST_WEIGHT = 1.0; // total weight of training images below which details fade
const float TINY = 1e-9;

// Weight of a surface at inverse distance there in an image in which it appears at here, a unit of which displaces
// it by shift pixels; farther is its distance over that of the ray. Images that see it from farther away are coarser.
float agreement(float there, float here, float shift, float turn, float farther) {
    float margin = SAME_DEPTH * max(there, here) + SAME_PIXELS / max(shift, TINY);
    float apart = (there - here) / margin, coarser = max(farther * farther, float(1));
    return exp(-min(apart * apart, float(80))) / ((turn + TURN) * coarser * coarser);
}

// Share of a residual at an angle. From the side, surfaces look different, and wrong depths displace details.
float faded(float turn) { return float(1) / (float(1) + turn / FADE * (turn / FADE)); }
