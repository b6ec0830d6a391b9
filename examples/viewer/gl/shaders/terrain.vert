// A vertex of the clipmap. Positions are relative to the viewer; the camera's own place is in no matrix.
in ivec2 in_vertex;  // grid units, within the patch
in ivec3 in_patch;   // grid units of the level, x y; level z

uniform mat4 u_view_projection;
uniform mat2 u_to_metres;    // level-0 samples to metres east and north
uniform vec2 u_fraction;     // the viewer within its level-0 cell
uniform float u_exaggeration;
uniform vec3 u_origin;       // where the clipmap's centre is at height 0, metres from the camera
uniform float u_sag;         // by which ground at distance d sinks, times d squared, 1 per metre; 0 means a flat map

out vec2 v_cell;      // grid units of the level
out vec2 v_relative;  // level-0 samples from the viewer
out vec3 v_position;  // metres from the camera
out vec2 v_surface;   // height in metres, validity
flat out int v_level;

void main() {
    GeometryLevel level = u_level[in_patch.z];
    ivec2 cell = in_patch.xy + in_vertex;
    float alpha = morph_alpha(vec2(cell), level.morph);
    v_surface = morphed_surface(cell, in_patch.z, level, alpha);
    // Exact integers first and one rounding last: vertices that two levels share come out bit-identical.
    v_relative = vec2(cell * level.place.z + level.place.xy) - u_fraction;
    v_position = vec3(u_to_metres * v_relative, v_surface.x * u_exaggeration) + u_origin;
    v_position.z -= u_sag * dot(v_position.xy, v_position.xy);
    v_cell = vec2(cell);
    v_level = in_patch.z;
    gl_Position = u_view_projection * vec4(v_position, 1.0);
}
