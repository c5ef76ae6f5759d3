/* Start of a program on QEMU's mps2-an386: the vector table, and the floating-point unit switched on. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

extern uint32_t __stack;
extern void initialise_monitor_handles(void); /* of semihosting: what is printed appears on the host */
extern int main(void);

void reset(void) {
  volatile uint32_t *const cpacr = (volatile uint32_t *)0xE000ED88u;
  *cpacr |= 0xFu << 20; /* coprocessors 10 and 11: full access */
  __asm volatile("dsb\n isb");
  initialise_monitor_handles();
  {
    const int code = main();
    (void)fflush(stdout);
    _Exit(code);
  }
}

static void fault(void) { _Exit(3); }

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &__stack, (const void *)reset, (const void *)fault, (const void *)fault, (const void *)fault, (const void *)fault,
};
