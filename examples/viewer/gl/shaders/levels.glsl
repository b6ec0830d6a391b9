// One geometry level; drawplan.GEOMETRY_LEVEL is its mirror.
struct GeometryLevel {
    ivec4 torus;  // slot of the window's first sample, x y; slot of the same place on the next coarser level, z w
    ivec4 place;  // first sample minus the viewer's cell, level-0 samples, x y; sample distance z; layer of the coarser level w
    vec4 morph;   // viewer in grid units, x y; start and rate of alpha, z w
};

layout(std140) uniform GeometryLevels {
    GeometryLevel u_level[MAX_LEVELS];
};
