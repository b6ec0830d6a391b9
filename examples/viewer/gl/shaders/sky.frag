// A plain sky: pale at the horizon, blue above.
in vec2 v_ndc;
uniform mat3 u_rays;  // from (x, y, 1) on the screen to a direction east, north, up
out vec4 f_colour;

void main() {
    float up = max(normalize(u_rays * vec3(v_ndc, 1.0)).z, 0.0);
    f_colour = vec4(mix(vec3(0.80, 0.87, 0.93), vec3(0.28, 0.47, 0.74), 1.0 - exp(-4.0 * up)), 1.0);
}
