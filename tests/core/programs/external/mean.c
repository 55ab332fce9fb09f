/* A program of several processes: they share the work, and the first one speaks. */

#include <mpi.h>

#include "physx.h"

int main(int argc, char **argv)
{
    double scale = 0.0, part = 0.0, sum = 0.0;
    int rank = 0, over = 0;
    physx_run run;
    physx_array sample[] = {{"sum", PHYSX_FLOAT64, 0, {0}, &sum}};
    physx_array wanted[] = {{"scale", PHYSX_FLOAT64, 0, {0}, &scale}};

    MPI_Init(&argc, &argv);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    if (rank == 0) over = physx_open(&run, sample, 1) || physx_parameters(&run, wanted, 1);
    MPI_Bcast(&over, 1, MPI_INT, 0, MPI_COMM_WORLD);
    MPI_Bcast(&scale, 1, MPI_DOUBLE, 0, MPI_COMM_WORLD);
    for (int step = 0; !over && step < 3; step++) {
        part = scale * (rank + 1) + step;
        MPI_Reduce(&part, &sum, 1, MPI_DOUBLE, MPI_SUM, 0, MPI_COMM_WORLD);
        if (rank == 0) over = physx_send(&run, sample, 1);
        MPI_Bcast(&over, 1, MPI_INT, 0, MPI_COMM_WORLD);
    }
    if (rank == 0 && !over) over = physx_close(&run);
    MPI_Finalize();
    return over ? 1 : 0;
}
