// Opens an asset, checks its self-test, and prints the radiance that an eye sees under a sun.
//     cc -O2 example.c $(pkg-config --cflags --libs hdf5) -lm -o example && ./example spot.h5 [EYE_X EYE_Y EYE_Z]
#include "prtbake.h"
#include <time.h>

// The harmonics Y [9] up to degree 2 in the unit direction d.
static void harmonics(const double *d, double *Y) {
    double x = d[0], y = d[1], z = d[2];
    Y[0] = 0.28209479177387814;
    Y[1] = 0.4886025119029199 * y, Y[2] = 0.4886025119029199 * z, Y[3] = 0.4886025119029199 * x;
    Y[4] = 1.0925484305920792 * x * y, Y[5] = 1.0925484305920792 * y * z, Y[7] = 1.0925484305920792 * x * z;
    Y[6] = 0.31539156525252005 * (3 * z * z - 1), Y[8] = 0.5462742152960396 * (x * x - y * y);
}

int main(int count, char **words) {
    static prt_asset asset;
    const double irradiance[3] = {3, 2.5, 2}, sun[3] = {2.0 / 7, 3.0 / 7, 6.0 / 7};  // from the sun, in object space
    double eye[3] = {2, 1, 4}, Y[9], b[27];
    clock_t begin = clock();
    if (count < 2 || !prt_open(words[1], &asset)) {
        fprintf(stderr, "%s\n", count < 2 ? "usage: example ASSET [EYE_X EYE_Y EYE_Z]" : asset.error);
        return 1;
    }
    double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC, off = prt_selftest(&asset);
    printf("%llu vertices in %.2f s, self-test %.1e\n", (unsigned long long)asset.vertices, seconds, off);
    if (!(off < 1e-3) || asset.degree > 2) return fprintf(stderr, "failed self-test, or a degree above 2\n"), 1;
    for (int c = 0; c < 3 && count == 5; c++) eye[c] = atof(words[2 + c]);
    harmonics(sun, Y);
    for (int i = 0; i < 27; i++) b[i] = Y[i / 3] * irradiance[i % 3];  // light of several lamps adds up

    begin = clock();
    double *radiance = (double *)malloc(3 * asset.vertices * sizeof(double));  // a colour for each vertex
    for (size_t v = 0; v < asset.vertices; v++) {
        double to_eye[3], square = 0;
        for (int c = 0; c < 3; c++) to_eye[c] = eye[c] - (asset.positions[3 * v + c] + asset.origin[c]);
        for (int c = 0; c < 3; c++) square += to_eye[c] * to_eye[c];
        for (int c = 0; c < 3; c++) to_eye[c] /= sqrt(square);
        prt_radiance(&asset, v, to_eye, b, radiance + 3 * v);
    }
    seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
    for (size_t v = 0; v < asset.vertices; v += asset.vertices / 5 + 1)
        printf("vertex %zu: %.6g %.6g %.6g\n", v, radiance[3 * v], radiance[3 * v + 1], radiance[3 * v + 2]);
    printf("%.2f ms for all vertices\n", 1e3 * seconds);
    free(radiance), prt_close(&asset);
    return 0;
}
