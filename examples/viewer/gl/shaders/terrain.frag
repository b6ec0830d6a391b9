// Colour of the terrain: imagery where there is some, else a tint by height, under one sun.
in vec2 v_cell;
in vec2 v_relative;
in vec3 v_position;
in vec2 v_surface;
flat in int v_level;

uniform sampler2DArray u_slopes;
uniform float u_exaggeration;
uniform vec3 u_sun;          // unit vector to the sun
uniform float u_ambient;     // light that comes from the whole sky, 0 to 1; 1 means no shading
uniform vec2 u_height_range; // metres
uniform float u_haze;        // extinction, 1 per metre; 0 means none
uniform float u_level_tint;  // 0 or 1: colour by level
uniform vec4 u_ground_edge;  // the edge of the heights relative to the viewer, level-0 samples
#if IMAGERY
uniform mat2 u_to_texels;    // level-0 height samples to level-0 texels
uniform vec4 u_image_edge;   // the imagery's edge relative to the viewer, level-0 texels
#endif
#if NORMALS
uniform mat2 u_facing;       // x and y of stored normals to east and north
#endif

out vec4 f_colour;

const vec3 HORIZON = vec3(0.80, 0.87, 0.93);
const vec3 TINTS[6] = vec3[6](vec3(0.47, 0.62, 0.46), vec3(0.62, 0.72, 0.50), vec3(0.82, 0.79, 0.57),
                              vec3(0.72, 0.58, 0.43), vec3(0.64, 0.58, 0.55), vec3(0.97, 0.97, 0.98));
const vec3 LEVELS[6] = vec3[6](vec3(0.90, 0.30, 0.25), vec3(0.95, 0.70, 0.20), vec3(0.45, 0.75, 0.30),
                               vec3(0.20, 0.70, 0.75), vec3(0.25, 0.40, 0.90), vec3(0.70, 0.35, 0.80));

vec3 to_linear(vec3 c) {
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c));
}

vec3 to_srgb(vec3 c) {
    return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}

// Green to white from the lowest land to the highest; blue below 0 where heights go deep enough to be a sea floor.
vec3 height_tint(float z) {
    bool has_sea = u_height_range.x < -100.0;
    float low = has_sea ? 0.0 : u_height_range.x;
    if (has_sea && z < 0.0) {
        return mix(vec3(0.56, 0.72, 0.84), vec3(0.16, 0.29, 0.52), clamp(z / u_height_range.x, 0.0, 1.0));
    }
    float t = 5.0 * clamp((z - low) / max(u_height_range.y - low, 1e-3), 0.0, 1.0);
    int i = min(int(t), 4);
    return mix(TINTS[i], TINTS[i + 1], t - float(i));
}

// Slopes are blended between levels with the same alpha as the heights.
vec3 surface_normal() {
    GeometryLevel level = u_level[v_level];
    float alpha = morph_alpha(v_cell, level.morph);
    vec2 slope = texture(u_slopes, vec3((v_cell + vec2(level.torus.xy) + 0.5) / float(SIDE), float(v_level))).rg;
    vec2 coarse = texture(u_slopes, vec3((0.5 * v_cell + vec2(level.torus.zw) + 0.5) / float(SIDE), float(level.place.w))).rg;
    slope = mix(slope, coarse, alpha) * u_exaggeration;
    return normalize(vec3(-slope, 1.0));
}

// Level ground comes out as bright as the imagery shows it; slopes towards the sun brighter, away from it darker.
float light_on(vec3 normal) {
    float direct = max(dot(normal, u_sun), 0.0) / max(u_sun.z, 0.2);
    return u_ambient + (1.0 - u_ambient) * min(direct, 2.0);
}

#if NORMALS
// A stored normal; what is exaggerated is steeper.
vec3 stored_normal(vec4 texel) {
    vec2 n = 255.0 * texel.rg / (texel.a * NORMAL_ZERO) - 1.0;
    return normalize(vec3(u_facing * n * u_exaggeration, sqrt(max(1.0 - dot(n, n), 1e-4))));
}
#endif

bool is_within(vec2 p, vec4 edge) {
    return all(greaterThanEqual(p, edge.xy)) && all(lessThanEqual(p, edge.zw));
}

void main() {
    vec3 normal = surface_normal();
    vec3 colour = height_tint(v_surface.x);
#if IMAGERY
    vec2 texel = u_to_texels * v_relative;
    vec2 across = dFdx(texel), down = dFdy(texel);
    float pixel = sqrt(max(dot(across, across), dot(down, down)));
    vec4 image = clipmap_texel(texel, pixel);
    bool on_image = is_within(texel, u_image_edge);
#if NORMALS
    normal = on_image && image.a > 0.0 ? stored_normal(image) : normal;
#elif BARE_GROUND
    colour = on_image ? colour * (1.0 - image.a) + image.rgb : colour;  // image.rgb is premultiplied
#else
    bool void_image = !on_image || image.a < 0.5;
    colour = image.rgb / max(image.a, 0.5);
#endif
#endif
    // After the derivatives, which a discarded neighbour would leave undefined.
    if (v_surface.y < 0.999 || !is_within(v_relative, u_ground_edge)) {
        discard;
    }
#if !BARE_GROUND
    if (void_image) {
        discard;
    }
#endif
    // Light is added in linear space. Texels are interpolated as they are stored: moderngl makes no arrays of sRGB textures.
    vec3 linear = to_linear(colour) * light_on(normal);
    if (u_haze > 0.0) {
        linear = mix(to_linear(HORIZON), linear, exp(-u_haze * length(v_position)));
    }
    vec3 shown = to_srgb(clamp(linear, 0.0, 1.0));
    vec3 tint = LEVELS[v_level - 6 * (v_level / 6)];
    f_colour = vec4(mix(shown, tint * (0.35 + 0.65 * light_on(normal)), 0.6 * u_level_tint), 1.0);
}
