// How a level turns into the next coarser one; morph.py is the mirror.
float morph_alpha(vec2 cell, vec4 morph) {
    vec2 distance = abs(cell - morph.xy);
    return clamp((max(distance.x, distance.y) - morph.z) * morph.w, 0.0, 1.0);
}

// Height and validity in a slot. The mask is a floor modulo; C's remainder is not one for negative numbers.
vec2 surface_at(ivec2 slot, int layer) {
    return texelFetch(u_surface, ivec3(slot & (SIDE - 1), layer), 0).rg;
}

// The coarser surface under a vertex: the middle of the coarse edge it lies on, the diagonal for an odd-odd vertex.
vec2 coarse_surface(ivec2 cell, GeometryLevel level) {
    ivec2 slot = (cell >> 1) + level.torus.zw;
    return 0.5 * (surface_at(slot, level.place.w) + surface_at(slot + (cell & 1), level.place.w));
}

// Not mix(): at alpha 1 the result must be the coarser surface to the last bit, or rims would not meet.
vec2 morphed_surface(ivec2 cell, int layer, GeometryLevel level, float alpha) {
    vec2 fine = surface_at(cell + level.torus.xy, layer);
    if (alpha <= 0.0) {
        return fine;
    }
    vec2 coarse = coarse_surface(cell, level);
    return alpha >= 1.0 ? coarse : fine * (1.0 - alpha) + coarse * alpha;
}
