/* A port for a Zynq-7000 without an operating system: what NAME_port.h asks of a board, on one Cortex-A9.

   Compile with -DLAW=robust beside an export with --xcp; link with zynq.ld, which has start-up code at its beginning here.
   Of the processing system are used the private timer of the CPU, its interrupt controller and UART 0. Converters and PWM are
   logic of your own: the registers at LOGIC below are what this port expects of it.

     LOGIC + 0x000 + 4 k   raw position k, signed, STEP_POSITION m each
     LOGIC + 0x100 + 4 k   raw current k, signed, STEP_CURRENT A each
     LOGIC + 0x1F0         raw link voltage, STEP_LINK V each; LOGIC + 0x1F4: 1 start, 2 acknowledge, 4 stop, 8 safe torque off
     LOGIC + 0x200 + 4 k   duty k, 0 .. what LOGIC + 0x2F0 reads: counts of a PWM period
     LOGIC + 0x2F4         gates: 1 on, 0 all switches open; LOGIC + 0x2F8: clock of the PWM, Hz */
#include <stdint.h>

#define JOIN(a, b) a##b
#define NAMED(a, b) JOIN(a, b)
#define TEXT(a) #a
#define QUOTED(a) TEXT(a)
#define LAW_(name) NAMED(LAW, name)
#include QUOTED(LAW_(_port.h))

typedef LAW_(_real) real;

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define UART 0xE0000000u
#define TIMER 0xF8F00600u
#define GLOBAL_TIMER 0xF8F00200u
#define CPU_INTERFACE 0xF8F00100u
#define DISTRIBUTOR 0xF8F01000u
#define LOGIC 0x43C00000u
#define TIMER_INTERRUPT 29u
#define TIMER_CLOCK 333333343.0 /* Hz, half of the processor's 666.67 MHz */
#define STEP_POSITION 1e-7      /* yours */
#define STEP_CURRENT 1e-3
#define STEP_LINK 1e-2
#define IDLE 1000000u /* rounds of the background without a byte: some milliseconds */

#define COUNT(member) ((int32_t)(sizeof(member) / sizeof(real)))

static uint32_t reload;

void LAW_(_port_begin)(LAW_(_board) * board) {
  REGISTER(UART) = 0x28u;        /* transmitter and receiver off */
  REGISTER(UART + 0x18u) = 124u; /* baud: 100 MHz / (124 x 7) = 115 207 */
  REGISTER(UART + 0x34u) = 6u;
  REGISTER(UART + 0x04u) = 0x20u; /* 8 bits, no parity, one stop bit */
  REGISTER(UART) = 0x17u;         /* reset and switch on */
  reload = (uint32_t)((SAMPLE_TIME * TIMER_CLOCK) + 0.5) - 1u;
  REGISTER(TIMER + 8u) = 0u;
  REGISTER(TIMER) = reload;
  board->period = (real)((double)(REGISTER(TIMER) + 1u) / TIMER_CLOCK); /* as it is read back */
#if defined(STAND_IN)
  board->current = (real)1e9;
  board->steps = (real)1e9;
  board->delay = (real)0.0;
#else
  REGISTER(LOGIC + 0x2F4u) = 0u;
  board->current = (real)(32767.0 * STEP_CURRENT);
  board->steps = (real)REGISTER(LOGIC + 0x2F0u);
  /* pulses of the next period of the PWM, whose middle is half of one later */
  board->delay = (real)(1.5 * (double)REGISTER(LOGIC + 0x2F0u) / (double)REGISTER(LOGIC + 0x2F8u));
#endif
}

void LAW_(_port_start)(void) {
  REGISTER(DISTRIBUTOR + 0x100u) = 1u << TIMER_INTERRUPT;
  REGISTER(DISTRIBUTOR) = 1u;
  REGISTER(CPU_INTERFACE + 4u) = 0xFFu;
  REGISTER(CPU_INTERFACE) = 1u;
  REGISTER(TIMER + 0xCu) = 1u;
  REGISTER(TIMER + 8u) = 7u; /* on, again and again, with its interrupt */
  __asm volatile("cpsie i");
}

/* Called by the vector below, with all registers saved. */
void on_interrupt(void);
void on_interrupt(void) {
  const uint32_t number = REGISTER(CPU_INTERFACE + 0xCu);
  if ((number & 0x3FFu) == TIMER_INTERRUPT) {
    REGISTER(TIMER + 0xCu) = 1u;
    LAW_(_on_sample)(0);
    if (REGISTER(TIMER + 0xCu) != 0u) {
      REGISTER(TIMER + 0xCu) = 1u; /* the sample took longer than its period */
      LAW_(_on_sample)(1);
    }
  }
  REGISTER(CPU_INTERFACE + 0x10u) = number;
}

#if defined(STAND_IN)
void LAW_(_port_write)(const LAW_(_outputs) * out, int32_t enable) {
  (void)out;
  (void)enable;
}
#else
void LAW_(_port_read)(LAW_(_inputs) * in, LAW_(_request) * request) {
  const uint32_t asked = REGISTER(LOGIC + 0x1F4u);
  int32_t k;
  for (k = 0; k < COUNT(in->y); k++) {
    in->y[k] = (real)((double)(int32_t)REGISTER(LOGIC + (4u * (uint32_t)k)) * STEP_POSITION);
    in->y_valid[k] = (real)1.0;
  }
#if defined(DRIVEN)
  for (k = 0; k < COUNT(in->i); k++) {
    in->i[k] = (real)((double)(int32_t)REGISTER(LOGIC + 0x100u + (4u * (uint32_t)k)) * STEP_CURRENT);
    in->i_valid[k] = (real)1.0;
  }
  in->link[0] = (real)((double)REGISTER(LOGIC + 0x1F0u) * STEP_LINK);
#endif
  request->start = (int32_t)(asked & 1u);
  request->acknowledge = (int32_t)((asked >> 1) & 1u);
  request->stop = (int32_t)((asked >> 2) & 1u);
  request->sto = (int32_t)((asked >> 3) & 1u);
  request->operate = 1;
}

void LAW_(_port_write)(const LAW_(_outputs) * out, int32_t enable) {
#if defined(DRIVEN)
  const double counts = (double)REGISTER(LOGIC + 0x2F0u);
  int32_t k;
  for (k = 0; k < COUNT(out->command); k++) {
    REGISTER(LOGIC + 0x200u + (4u * (uint32_t)k)) = (uint32_t)((double)out->command[k] * counts);
  }
#else
  (void)out;
#endif
  REGISTER(LOGIC + 0x2F4u) = (uint32_t)enable;
}
#endif

int32_t LAW_(_port_get)(void) {
  static uint32_t idle = 0u;
  int32_t byte = -1;
  if ((REGISTER(UART + 0x2Cu) & 2u) == 0u) {
    byte = (int32_t)(REGISTER(UART + 0x30u) & 0xFFu);
    idle = 0u;
  } else if (idle < IDLE) {
    idle++;
  } else {
    idle = 0u;
    byte = -2;
  }
  return byte;
}

void LAW_(_port_put)(uint32_t byte) {
  while ((REGISTER(UART + 0x2Cu) & 0x10u) != 0u) {
  }
  REGISTER(UART + 0x30u) = byte;
}

/* From reset to main: vectors, stacks, the floating-point unit, zeros; an interrupt saves all that a step may use. */
__asm(".section .start, \"ax\"\n.arm\n.global _start\n"
      "_start: b begin\n b hang\n b hang\n b hang\n b hang\n b hang\n b interrupt\n b hang\n"
      "begin: cpsid if\n ldr r0, =_start\n mcr p15, 0, r0, c12, c0, 0\n"
      " mrc p15, 0, r0, c1, c0, 2\n orr r0, r0, #0xF00000\n mcr p15, 0, r0, c1, c0, 2\n isb\n"
      " mov r0, #0x40000000\n vmsr fpexc, r0\n"
      " cps #0x12\n ldr sp, =interrupt_stack\n cps #0x1F\n ldr sp, =main_stack\n"
      " ldr r0, =bss_begin\n ldr r1, =bss_end\n mov r2, #0\n"
      "1: cmp r0, r1\n strlo r2, [r0], #4\n blo 1b\n bl main\n"
      "hang: b hang\n"
      "interrupt: sub lr, lr, #4\n push {r0-r3, r12, lr}\n vpush {d0-d7}\n vpush {d16-d31}\n vmrs r0, fpscr\n"
      " push {r0, r1}\n bl on_interrupt\n pop {r0, r1}\n vmsr fpscr, r0\n vpop {d16-d31}\n vpop {d0-d7}\n"
      " ldmfd sp!, {r0-r3, r12, pc}^\n"
      ".ltorg\n.text\n");
