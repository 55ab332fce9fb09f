! physx: sends the samples of a simulation in Fortran to physx. See docs/external.md of physx.
!
!     use physx
!     real(c_double), target :: u(n, n), t, alpha
!     type(physx_run) :: run
!     type(physx_array) :: sample(2), wanted(1)
!
!     sample = [physx_field("u", u), physx_field("t", t)]
!     wanted = [physx_field("alpha", alpha)]
!     if (physx_open(run, sample) /= 0) stop 1
!     if (physx_parameters(run, wanted) /= 0) stop 1
!     do step = 1, steps
!         ...                                          ! simulate
!         if (physx_send(run, sample) /= 0) stop 1
!     end do
!     if (physx_close(run) /= 0) stop 1
!
! Each function returns 0, or -1 if the run is over or after a mistake, which is written to stderr;
! all later calls then return -1 as well. In an MPI program only one process calls them, unless each
! begins with physx_open_part.

module physx
    use, intrinsic :: iso_c_binding
    implicit none
    private
    public :: physx_run, physx_array, physx_field, physx_open, physx_parameters, physx_send
    public :: physx_predict, physx_close, physx_any_shape, physx_open_part
    public :: c_double, c_float, c_int8_t, c_int16_t, c_int32_t, c_int64_t, c_bool
    public :: c_double_complex, c_float_complex

    integer(c_int), parameter :: physx_any_shape = -1
    !! Rank of a field whose shape is taken from the first sample: sample(1)%rank = physx_any_shape.

    ! As in physx.h.
    type, bind(c) :: physx_array
        character(kind=c_char) :: name(52) = c_null_char
        integer(c_int) :: type = 0
        integer(c_int) :: rank = 0
        integer(c_int64_t) :: shape(8) = 0
        type(c_ptr) :: data = c_null_ptr
    end type

    type, bind(c) :: physx_run
        integer(c_int) :: socket = -1
    end type

    interface
        subroutine c_describe(array, name, values) bind(c, name="physx_fortran_describe")
            import :: physx_array, c_char
            type(physx_array), intent(out) :: array
            character(kind=c_char, len=*), intent(in) :: name
            type(*), dimension(..), target :: values
        end subroutine

        integer(c_int) function c_open(run, fields, count) bind(c, name="physx_open")
            import :: physx_run, physx_array, c_int
            type(physx_run), intent(inout) :: run
            type(physx_array), intent(in) :: fields(*)
            integer(c_int), value :: count
        end function

        integer(c_int) function c_open_part(run, rank, ranks, fields, offsets, count) &
                bind(c, name="physx_open_part")
            import :: physx_run, physx_array, c_int, c_int64_t
            type(physx_run), intent(inout) :: run
            integer(c_int), value :: rank, ranks
            type(physx_array), intent(in) :: fields(*)
            integer(c_int64_t), intent(in) :: offsets(*)
            integer(c_int), value :: count
        end function

        integer(c_int) function c_parameters(run, wanted, count) bind(c, name="physx_parameters")
            import :: physx_run, physx_array, c_int
            type(physx_run), intent(inout) :: run
            type(physx_array), intent(in) :: wanted(*)
            integer(c_int), value :: count
        end function

        integer(c_int) function c_send(run, sample, count) bind(c, name="physx_send")
            import :: physx_run, physx_array, c_int
            type(physx_run), intent(inout) :: run
            type(physx_array), intent(in) :: sample(*)
            integer(c_int), value :: count
        end function

        integer(c_int) function c_predict(run, inputs, input_count, outputs, output_count) &
                bind(c, name="physx_predict")
            import :: physx_run, physx_array, c_int
            type(physx_run), intent(inout) :: run
            type(physx_array), intent(in) :: inputs(*), outputs(*)
            integer(c_int), value :: input_count, output_count
        end function

        integer(c_int) function c_close(run) bind(c, name="physx_close")
            import :: physx_run, c_int
            type(physx_run), intent(inout) :: run
        end function
    end interface

contains

    !> Name a variable or a contiguous array, which must be a target and must not move. Following
    !> the memory layout, physx sees u(i, j) as u[j, i].
    function physx_field(name, values) result(array)
        character(kind=c_char, len=*), intent(in) :: name
        type(*), dimension(..), target :: values
        type(physx_array) :: array
        call c_describe(array, name, values)
    end function

    !> Connect to the run that started this program, and declare the fields of a sample.
    integer(c_int) function physx_open(run, fields) result(status)
        type(physx_run), intent(inout) :: run
        type(physx_array), intent(in) :: fields(:)
        status = c_open(run, fields, size(fields, kind=c_int))
    end function

    !> As physx_open, in each of several processes that send parts of each sample. All of them make
    !> the same calls in the same order then. A field that several declare is divided along its last
    !> axis: the part of this process begins after so many indices of the whole field. The others
    !> are whole.
    integer(c_int) function physx_open_part(run, rank, ranks, fields, offsets) result(status)
        type(physx_run), intent(inout) :: run
        integer(c_int), intent(in) :: rank, ranks
        type(physx_array), intent(in) :: fields(:)
        integer(c_int64_t), intent(in) :: offsets(:)
        status = c_open_part(run, rank, ranks, fields, offsets, size(fields, kind=c_int))
    end function

    !> Receive parameters by name. A call after a sample begins a new episode, and waits until it
    !> is due.
    integer(c_int) function physx_parameters(run, wanted) result(status)
        type(physx_run), intent(inout) :: run
        type(physx_array), intent(in) :: wanted(:)
        status = c_parameters(run, wanted, size(wanted, kind=c_int))
    end function

    !> Send a sample: all fields. It is one step of the environment.
    integer(c_int) function physx_send(run, sample) result(status)
        type(physx_run), intent(inout) :: run
        type(physx_array), intent(in) :: sample(:)
        status = c_send(run, sample, size(sample, kind=c_int))
    end function

    !> Receive the network's prediction for the inputs into the outputs. Both have the names of its
    !> fields.
    integer(c_int) function physx_predict(run, inputs, outputs) result(status)
        type(physx_run), intent(inout) :: run
        type(physx_array), intent(in) :: inputs(:), outputs(:)
        status = c_predict(run, inputs, size(inputs, kind=c_int), outputs, &
            size(outputs, kind=c_int))
    end function

    !> Report that the program has sent all its samples, and disconnect. A program that ends without
    !> this call has failed.
    integer(c_int) function physx_close(run) result(status)
        type(physx_run), intent(inout) :: run
        status = c_close(run)
    end function

end module
