/* The heat equation on a square of n x n points, cold at its border: heat N STEPS EPISODES [ask].

   With "ask" it asks the network before each sample what it predicts for it. */

#include "physx.h"

static void start(double *u, int n, int64_t seed)
{
    for (int i = 0; i < n * n; i++) {
        seed = (1103515245 * seed + 12345) % 2147483648;
        u[i] = (double)seed / 2147483648.0;
    }
}

static double at(const double *u, int n, int i, int j)
{
    return i < 0 || j < 0 || i >= n || j >= n ? 0.0 : u[i * n + j];
}

static void advance(const double *u, double *next, int n, double alpha)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            next[i * n + j] = at(u, n, i, j) +
                              alpha * (at(u, n, i - 1, j) + at(u, n, i + 1, j) +
                                       at(u, n, i, j - 1) + at(u, n, i, j + 1) -
                                       4.0 * at(u, n, i, j));
}

int main(int argc, char **argv)
{
    int n = argc > 1 ? atoi(argv[1]) : 8, steps = argc > 2 ? atoi(argv[2]) : 3;
    int episodes = argc > 3 ? atoi(argv[3]) : 1, asks = argc > 4, over = 0;
    double alpha = 0.0;
    int32_t seed = 0, step = 0;
    double *u = (double *)calloc((size_t)(3 * n * n), sizeof *u);
    double *next = u + n * n, *predicted = u + 2 * n * n;
    physx_run run;
    physx_array sample[] = {{"u", PHYSX_FLOAT64, 2, {n, n}, u},
                            {"next", PHYSX_FLOAT64, 2, {n, n}, next},
                            {"alpha", PHYSX_FLOAT64, 0, {0}, &alpha},
                            {"seed", PHYSX_INT32, 0, {0}, &seed},
                            {"count", PHYSX_INT32, 0, {0}, &step},
                            {"predicted", PHYSX_FLOAT64, 2, {n, n}, predicted}};
    physx_array wanted[] = {{"alpha", PHYSX_FLOAT64, 0, {0}, &alpha},
                            {"seed", PHYSX_INT32, 0, {0}, &seed}};
    physx_array input[] = {{"u", PHYSX_FLOAT64, 2, {n, n}, u}};
    physx_array output[] = {{"next", PHYSX_FLOAT64, 2, {n, n}, predicted}};
    int fields = asks ? 6 : 5;

    over = physx_open(&run, sample, fields);
    for (int episode = 0; !over && episode < episodes; episode++) {
        over = physx_parameters(&run, wanted, 2);
        start(u, n, seed);
        for (step = 0; !over && step < steps; step++) {
            if (alpha > 0.25 && step == 1) {
                fprintf(stderr, "%g is unstable\n", alpha);
                return 3;
            }
            advance(u, next, n, alpha);
            over = (asks && physx_predict(&run, input, 1, output, 1)) ||
                   physx_send(&run, sample, fields);
            memcpy(u, next, (size_t)(n * n) * sizeof *u);
        }
    }
    over = over || physx_close(&run);
    free(u);
    return over ? 1 : 0;
}
