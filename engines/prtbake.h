// prtbake.h: opens an asset of prtbake, an HDF5 file, and gives the radiance of its vertices. C99 or C++, little-endian.
//     cc program.c $(pkg-config --cflags --libs hdf5) -lm       A program: example.c. The file: docs/reference/asset.md.
//     L(v, ωo) = max(0, Σ_bin w(ωo) Σ_k coefficients[v,bin,k] b[k]); ωo: unit, to the eye, in object space
#include <hdf5.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    char error[1024];                                    // one sentence, if prt_open returned 0
    hsize_t vertices, faces, tests, shape[4];            // shape: of the coefficients, 1 for axes that do not matter
    int rings, sectors, degree, one_light, half;         // b is [(degree + 1)²,3]; it is not used if one_light
    double origin[3];                                    // object space is positions + origin
    float *positions, *normals, *tangents;               // [vertices,3]
    unsigned *triangles;                                 // [faces,3]
    unsigned char *valid;                                // [vertices]; 0: not baked, black
    void *coefficients;                                  // [vertices,bins,terms,channels], halves if `half`, else floats
    unsigned *test_vertex;                               // the self-test: [tests]; 0 rows if there is none
    double *test_light, *test_outgoing, *test_radiance;  // [(degree + 1)²,3], [tests,3], [tests,3]
} prt_asset;

static inline int prt_attribute(hid_t file, const char *group, const char *name, hid_t type, hssize_t count, void *value) {
    hid_t attribute = H5Aopen_by_name(file, group, name, H5P_DEFAULT, H5P_DEFAULT), space = H5Aget_space(attribute);
    int good = H5Sget_simple_extent_npoints(space) == count && H5Aread(attribute, type, value) >= 0;
    H5Sclose(space), H5Aclose(attribute);
    return good;
}

static inline int prt_begins(hid_t file, const char *group, const char *name, const char *beginning) {
    char *text = NULL;
    hid_t type = H5Tcopy(H5T_C_S1);
    H5Tset_size(type, H5T_VARIABLE), H5Tset_cset(type, H5T_CSET_UTF8);
    int same = prt_attribute(file, group, name, type, 1, &text) && text && !strncmp(text, beginning, strlen(beginning));
    H5free_memory(text), H5Tclose(type);
    return same;
}

static inline void *prt_read(prt_asset *a, hid_t file, const char *name, hid_t type, hsize_t *rows, hsize_t columns) {
    hid_t set = H5Dopen2(file, name, H5P_DEFAULT), space = H5Dget_space(set);
    hsize_t count = set < 0 ? 0 : (hsize_t)H5Sget_simple_extent_npoints(space);
    if (!*rows) *rows = count / columns;
    void *values = count >> 40 ? NULL : malloc(count * H5Tget_size(type) + 1);
    if (!values || count != *rows * columns || H5Dread(set, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, values) < 0)
        snprintf(a->error, sizeof a->error, "/%s is missing, damaged or of another size; bake it again", name);
    H5Sclose(space), H5Dclose(set);
    return values;
}

static inline const char *prt_load(prt_asset *a, hid_t file) {
    if (file < 0) return "is missing, truncated or not HDF5";
    if (!prt_begins(file, "/", "format", "prtbake")) return "is not an asset of prtbake";
    if (!prt_begins(file, "/", "format_version", "1.")) return "has another format_version than 1.x; copy the newer prtbake.h";
    if (H5Lexists(file, "transfer_compact", H5P_DEFAULT) > 0) return "is compact; unpack it: "
        "python3 -c \"import prt_bake as p; p.write_asset(p.unpacked(p.read_asset('COMPACT.h5')), 'PLAIN.h5')\"";
    int known = prt_attribute(file, "bins", "rings", H5T_NATIVE_INT, 1, &a->rings) &&
                prt_attribute(file, "bins", "sectors", H5T_NATIVE_INT, 1, &a->sectors) &&
                prt_attribute(file, "basis", "degree", H5T_NATIVE_INT, 1, &a->degree) &&
                prt_attribute(file, "mesh/positions", "origin", H5T_NATIVE_DOUBLE, 3, a->origin);
    if (!known || a->rings < 1 || a->sectors < 1 || a->degree < 0) return "lacks its rings, sectors, degree or origin";
    hsize_t bins = (hsize_t)a->rings * a->sectors, terms = (hsize_t)a->degree + 1, *s = a->shape;
    terms *= terms;
    a->one_light = prt_begins(file, "transfer", "quantity", "radiance");
    hid_t set = H5Dopen2(file, "transfer/coefficients", H5P_DEFAULT), space = H5Dget_space(set), type = H5Dget_type(set);
    if (H5Sget_simple_extent_ndims(space) == 4) H5Sget_simple_extent_dims(space, s, NULL);
    a->half = H5Tget_size(type) == 2;
    hid_t as = a->half ? type : H5T_NATIVE_FLOAT;  // not converted: that takes ten times as long as all of the rest
    if (s[0] && (s[1] == bins || s[1] == 1) && s[2] == (a->one_light ? 1 : terms) && (s[3] == 3 || s[3] == 1))
        a->coefficients = prt_read(a, file, "transfer/coefficients", as, s, s[1] * s[2] * s[3]);
    H5Tclose(type), H5Sclose(space), H5Dclose(set);
    if (!a->coefficients) return "has no /transfer/coefficients [V, B or 1, K or 1, 3 or 1]";
    a->vertices = s[0];
    a->positions = (float *)prt_read(a, file, "mesh/positions", H5T_NATIVE_FLOAT, s, 3);
    a->normals = (float *)prt_read(a, file, "mesh/normals", H5T_NATIVE_FLOAT, s, 3);
    a->tangents = (float *)prt_read(a, file, "mesh/tangents", H5T_NATIVE_FLOAT, s, 3);
    a->triangles = (unsigned *)prt_read(a, file, "mesh/faces", H5T_NATIVE_UINT, &a->faces, 3);
    for (hsize_t i = 0; !a->error[0] && i < 3 * a->faces; i++)
        if (a->triangles[i] >= s[0]) return "has faces of vertices that it lacks";
    a->valid = (unsigned char *)prt_read(a, file, "transfer/valid", H5T_NATIVE_UCHAR, s, 1);
    if (H5Lexists(file, "selftest/vertex", H5P_DEFAULT) <= 0) return a->error;
    a->test_vertex = (unsigned *)prt_read(a, file, "selftest/vertex", H5T_NATIVE_UINT, &a->tests, 1);
    a->test_light = (double *)prt_read(a, file, "selftest/light", H5T_NATIVE_DOUBLE, &terms, 3);
    a->test_outgoing = (double *)prt_read(a, file, "selftest/outgoing", H5T_NATIVE_DOUBLE, &a->tests, 3);
    a->test_radiance = (double *)prt_read(a, file, "selftest/radiance", H5T_NATIVE_DOUBLE, &a->tests, 3);
    for (hsize_t i = 0; !a->error[0] && i < a->tests; i++)
        if (a->test_vertex[i] >= s[0]) return "has a self-test of vertices that it lacks";
    return a->error;
}

static inline void prt_close(prt_asset *a) {
    void *all[] = {a->positions, a->normals, a->tangents, a->triangles, a->valid, a->coefficients, a->test_vertex,
                   a->test_light, a->test_outgoing, a->test_radiance};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) free(all[i]);
    memset(a, 0, sizeof *a);
}

// 1, or 0 and a sentence in a->error.
static inline int prt_open(const char *path, prt_asset *a) {
    char problem[200];
    H5E_auto2_t print;
    void *data;
    memset(a, 0, sizeof *a);
    H5Eget_auto2(H5E_DEFAULT, &print, &data), H5Eset_auto2(H5E_DEFAULT, NULL, NULL);
    hid_t file = H5Fopen(path, H5F_ACC_RDONLY, H5P_DEFAULT);
    snprintf(problem, sizeof problem, "%.199s", prt_load(a, file));
    H5Fclose(file), H5Eset_auto2(H5E_DEFAULT, print, data);
    if (!problem[0]) return 1;
    prt_close(a), snprintf(a->error, sizeof a->error, "%.800s %s", path, problem);
    return 0;
}

static inline double prt_number(const prt_asset *a, size_t i) {
    if (!a->half) return ((const float *)a->coefficients)[i];
    unsigned half = ((const unsigned short *)a->coefficients)[i], bits = (half & 32768u) << 16 | (half & 32767u) << 13;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value * 5.192296858534828e33f;  // 2^112: the exponents of floats begin 112 lower
}

static inline void prt_add_bin(const prt_asset *a, size_t vertex, size_t bin, double weight, const double *b, double *rgb) {
    size_t terms = a->shape[2], channels = a->shape[3], begin = (vertex * a->shape[1] + bin % a->shape[1]) * terms;
    for (size_t i = 0; i < 3 * terms; i++)
        rgb[i % 3] += weight * (a->one_light ? 1 : b[i]) * prt_number(a, (begin + i / 3) * channels + i % 3 % channels);
}

// Sets rgb [3], which is below 0 here and there.
static inline void prt_unclamped(const prt_asset *a, size_t vertex, const double *to_eye, const double *b, double *rgb) {
    const float *n = a->normals + 3 * vertex, *t = a->tangents + 3 * vertex;
    double x = 0, y = 0, z = 0;
    for (int c = 0; c < 3; c++) {
        double across = (double)n[(c + 1) % 3] * t[(c + 2) % 3] - (double)n[(c + 2) % 3] * t[(c + 1) % 3];
        x += to_eye[c] * t[c], y += to_eye[c] * across, z += to_eye[c] * n[c];
    }
    double depth = (1 - z) * a->rings - 0.5, r = fmin(fmax(depth, 0), a->rings - 1);
    double turn = atan2(y, x) / 6.283185307179586 * a->sectors - 0.5, pole = fmin(fmax(-2 * depth, 0), 1);
    int i = (int)r, j = (int)floor(turn), below = i + 1 < a->rings ? i + 1 : i;
    rgb[0] = rgb[1] = rgb[2] = 0;
    for (int side = 0; side < 2; side++) {
        double share = (1 - pole) * (side ? turn - j : 1 - (turn - j));
        int sector = (j + side + a->sectors) % a->sectors;
        prt_add_bin(a, vertex, a->sectors * i + sector, share * (1 - (r - i)), b, rgb);
        prt_add_bin(a, vertex, a->sectors * below + sector, share * (r - i), b, rgb);
    }
    for (int s = 0; pole > 0 && s < a->sectors; s++) prt_add_bin(a, vertex, s, pole / a->sectors, b, rgb);
}

static inline void prt_radiance(const prt_asset *a, size_t vertex, const double *to_eye, const double *b, double *rgb) {
    prt_unclamped(a, vertex, to_eye, b, rgb);
    for (int c = 0; c < 3; c++) rgb[c] = fmax(rgb[c], 0);
}

// The largest difference from the rows of the self-test, relative to the largest of them: at most 1e-3; NaN without rows.
static inline double prt_selftest(const prt_asset *a) {
    double off = 0, largest = 0, rgb[3];
    for (size_t row = 0; row < a->tests; row++) {
        prt_unclamped(a, a->test_vertex[row], a->test_outgoing + 3 * row, a->test_light, rgb);
        for (size_t c = 0; c < 3; c++) largest = fmax(largest, fabs(a->test_radiance[3 * row + c]));
        for (size_t c = 0; c < 3; c++) {
            double by = fabs(rgb[c] - a->test_radiance[3 * row + c]);
            off = by <= off || off != off ? off : by;  // stays NaN
        }
    }
    return off / largest;
}
