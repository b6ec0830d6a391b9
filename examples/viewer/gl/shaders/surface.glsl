uniform sampler2DArray u_surface;  // height in metres, validity
