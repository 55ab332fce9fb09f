/* An MPI program, each of whose ranks has rows of a field. */

#include <mpi.h>

#include "physx.h"

enum { ROWS = 2, COLUMNS = 3, STEPS = 3 };

int main(int argc, char **argv)
{
    double u[ROWS][COLUMNS], sum = 0.0, part = 0.0, scale = 0.0;
    int rank = 0, ranks = 0, over = 0;
    MPI_Init(&argc, &argv);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);

    physx_run run;
    physx_array sample[] = {{"u", PHYSX_FLOAT64, 2, {ROWS, COLUMNS}, u},
                            {"sum", PHYSX_FLOAT64, 0, {0}, &sum}};
    physx_array wanted[] = {{"scale", PHYSX_FLOAT64, 0, {0}, &scale}};
    const int64_t offsets[] = {ROWS * rank, 0};
    const int fields = rank == 0 ? 2 : 1; /* the sum is one number: rank 0 sends it */

    over = physx_open_part(&run, rank, ranks, sample, offsets, fields) ||
           physx_parameters(&run, wanted, 1);
    for (int step = 0; !over && step < STEPS; step++) {
        part = 0.0;
        for (int i = 0; i < ROWS; i++)
            for (int j = 0; j < COLUMNS; j++)
                part += u[i][j] = scale * (offsets[0] + i) + 10 * step + j;
        MPI_Reduce(&part, &sum, 1, MPI_DOUBLE, MPI_SUM, 0, MPI_COMM_WORLD);
        over = physx_send(&run, sample, fields);
    }
    over = over || physx_close(&run);
    MPI_Finalize();
    return over ? 1 : 0;
}
