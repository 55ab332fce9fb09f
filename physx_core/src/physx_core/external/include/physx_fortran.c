/* physx_fortran.c: the functions that physx.f90 calls. Compile it with the companion C compiler. */

#define PHYSX_API
#include "physx.h"

#include <ISO_Fortran_binding.h>

int physx_fortran_type(const CFI_cdesc_t *values);
void physx_fortran_describe(physx_array *array, const CFI_cdesc_t *name, const CFI_cdesc_t *values);

int physx_fortran_type(const CFI_cdesc_t *values)
{
    int size = (int)values->elem_len, kind = 0;
    switch (values->type & CFI_type_mask) {
    case CFI_type_Integer: kind = 'i'; break;
    case CFI_type_Logical: kind = size == 1 ? 'b' : 0; break;
    case CFI_type_Real: kind = 'f'; break;
    case CFI_type_Complex: kind = 'c'; break;
    }
    return kind ? kind * 256 + size : 0;
}

/* Fortran's first index varies fastest, NumPy's last index does: the axes are reversed. */
void physx_fortran_describe(physx_array *array, const CFI_cdesc_t *name, const CFI_cdesc_t *values)
{
    size_t length = name->elem_len;
    int axis;
    memset(array, 0, sizeof *array);
    if (length >= PHYSX_NAME) length = PHYSX_NAME; /* too long: physx.h reports it */
    memcpy(array->name, name->base_addr, length);
    if (length < PHYSX_NAME)
        while (length && array->name[length - 1] == ' ') array->name[--length] = 0;
    array->rank = values->rank;
    for (axis = 0; axis < values->rank && axis < PHYSX_RANK; axis++)
        array->shape[axis] = (int64_t)values->dim[values->rank - 1 - axis].extent;
    array->data = values->base_addr;
    if (values->rank == 0 || CFI_is_contiguous(values))
        array->type = (physx_type)physx_fortran_type(values);
    else
        fprintf(stderr, "physx: physx_field: %.51s: the array must be contiguous\n", array->name);
}
