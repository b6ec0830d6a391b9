// Which level of the texture clipmap a fragment takes; texlod.py is the mirror.
struct TextureLevel {
    vec4 bounds;  // usable part of the window relative to the viewer, texels of the level
    vec4 edge;    // middle of the level's outermost texels relative to the viewer
    vec4 base;    // the viewer on the torus, x y
};

layout(std140) uniform TextureLevels {
    TextureLevel u_texture[MAX_LEVELS];
};

uniform sampler2DArray u_imagery;

const float EVERYWHERE = 1e30;

float rim_distance(vec2 texel, int l) {
    vec2 p = texel * exp2(-float(l));
    vec2 inside = min(p - u_texture[l].bounds.xy, u_texture[l].bounds.zw - p);
    return min(inside.x, inside.y);
}

// The first level from `first` whose window holds the fragment (x), and the distance to its rim (y).
vec2 available_level(vec2 texel, int first) {
    for (int l = first; l < TEXTURE_LEVELS - 1; ++l) {
        float inside = rim_distance(texel, l);
        if (inside >= 0.0) {
            return vec2(float(l), inside);
        }
    }
    return vec2(float(TEXTURE_LEVELS - 1), EVERYWHERE);
}

// Level (x), coarser level (y) and weight of the coarser one (z). `texel` is in level-0 texels from the viewer.
vec3 choose_levels(vec2 texel, float preferred) {
    const int last = TEXTURE_LEVELS - 1;
    preferred = min(preferred, float(last));
    vec2 found = available_level(texel, int(preferred));
    float level = max(preferred, found.x + clamp(1.0 - found.y / BLEND_PX, 0.0, 1.0));
    int whole = int(level);
    float fine = available_level(texel, min(whole, last)).x;
    float coarse = available_level(texel, min(whole + 1, last)).x;
    return vec3(fine, coarse, level - float(whole));
}

vec4 texel_of_level(vec2 texel, int l) {
    vec2 p = clamp(texel * exp2(-float(l)), u_texture[l].edge.xy, u_texture[l].edge.zw);
    return textureLod(u_imagery, vec3((p + u_texture[l].base.xy) / TEXTURE_SIDE, float(l)), 0.0);
}

// `longest` is the length of the longer side of a pixel, level-0 texels.
vec4 clipmap_texel(vec2 texel, float longest) {
    vec3 chosen = choose_levels(texel, max(0.0, log2(max(longest, 1e-10))));
    vec4 fine = texel_of_level(texel, int(chosen.x));
    return chosen.z > 0.0 ? mix(fine, texel_of_level(texel, int(chosen.y)), chosen.z) : fine;
}
