! Each of several processes has columns of a field: the last axis is divided, NumPy's first one.

program parts
    use physx
    implicit none
    integer, parameter :: columns = 2, rows = 3, ranks = 2
    real(c_double), target :: u(rows, columns), t, scale
    type(physx_run) :: run
    type(physx_array) :: sample(2), wanted(1)
    character(len=10) :: word
    integer :: rank, step, i, j, fields

    call get_environment_variable("RANK", word)
    read (word, *) rank
    sample = [physx_field("u", u), physx_field("t", t)]
    wanted = [physx_field("scale", scale)]
    fields = merge(2, 1, rank == 0)
    if (physx_open_part(run, rank, ranks, sample(:fields), &
        [int(columns * rank, c_int64_t), 0_c_int64_t]) /= 0) stop 1
    if (physx_parameters(run, wanted) /= 0) stop 1
    do step = 0, 2
        t = step
        do j = 1, columns
            do i = 1, rows
                u(i, j) = scale * (columns * rank + j - 1) + 10 * step + i - 1
            end do
        end do
        if (physx_send(run, sample(:fields)) /= 0) stop 1
    end do
    if (physx_close(run) /= 0) stop 1
end program
