! The heat equation on a square of n x n points, cold at its border: heat N STEPS EPISODES [ask].
!
! It is the program heat.c in Fortran.

program heat
    use physx
    implicit none
    integer, parameter :: real64 = c_double
    integer :: n, steps, episodes, episode, fields, over
    logical :: asks
    real(real64), allocatable, target :: u(:, :), next(:, :), predicted(:, :), grid(:, :)
    real(real64), target :: alpha
    integer(c_int32_t), target :: seed, step
    type(physx_run) :: run
    type(physx_array) :: sample(6), wanted(2), input(1), output(1)

    n = argument(1)
    steps = argument(2)
    episodes = argument(3)
    asks = command_argument_count() > 3
    allocate (u(n, n), next(n, n), predicted(n, n), grid(0:n + 1, 0:n + 1))
    predicted = 0
    alpha = 0
    seed = 0
    sample = [physx_field("u", u), physx_field("next", next), physx_field("alpha", alpha), &
              physx_field("seed", seed), physx_field("count", step), &
              physx_field("predicted", predicted)]
    wanted = [physx_field("alpha", alpha), physx_field("seed", seed)]
    input = [physx_field("u", u)]
    output = [physx_field("next", predicted)]
    fields = merge(6, 5, asks)

    over = physx_open(run, sample(:fields))
    do episode = 1, episodes
        if (over == 0) over = physx_parameters(run, wanted)
        call start(u, seed)
        do step = 0, steps - 1
            if (alpha > 0.25_real64 .and. step == 1) stop 3
            call advance(u, next, alpha)
            if (over == 0 .and. asks) over = physx_predict(run, input, output)
            if (over == 0) over = physx_send(run, sample(:fields))
            u = next
        end do
    end do
    if (over == 0) over = physx_close(run)
    deallocate (u, next, predicted, grid)
    if (over /= 0) stop 1

contains

    integer function argument(number)
        integer, intent(in) :: number
        character(len=20) :: text
        call get_command_argument(number, text)
        read (text, *) argument
    end function

    subroutine start(u, seed)
        real(real64), intent(out) :: u(:, :)
        integer(c_int32_t), intent(in) :: seed
        integer(c_int64_t) :: state
        integer :: i, j
        state = seed
        do i = 1, n
            do j = 1, n
                state = mod(1103515245_c_int64_t * state + 12345, 2147483648_c_int64_t)
                u(j, i) = real(state, real64) / 2147483648.0_real64
            end do
        end do
    end subroutine

    subroutine advance(u, next, alpha)
        real(real64), intent(in) :: u(:, :), alpha
        real(real64), intent(out) :: next(:, :)
        integer :: i, j
        grid = 0
        grid(1:n, 1:n) = u
        do i = 1, n
            do j = 1, n
                next(j, i) = grid(j, i) + alpha * (grid(j, i - 1) + grid(j, i + 1) &
                                                   + grid(j - 1, i) + grid(j + 1, i) &
                                                   - 4.0_real64 * grid(j, i))
            end do
        end do
    end subroutine

end program
